import numpy as np
import pytest

import perfcontrol as pc
from tests.oracles.lqr import riccati_gain
from tests.tools import assert_close, assert_refused, normal, random_psd

A, B = 0.6 * np.asarray(normal(1, 3, 3)), np.asarray(normal(2, 3, 2))
Q, R = np.asarray(random_psd(3, 3)), np.asarray(random_psd(4, 2))


@pytest.mark.float32
def test_designed_gain_matches_the_riccati_oracle():
    assert_close(pc.design_gain(pc.LinearSystem(A, B), Q=Q, R=R), riccati_gain(A, B, Q, R), 1e-10, 1e-4)


def test_designed_gain_of_a_varying_system_matches_batch_least_squares():
    """The first input of the finite-horizon optimum, minimised over the whole input sequence at once."""
    T = 5
    As, Bs = 0.6 * np.asarray(normal(5, T, 3, 3)), np.asarray(normal(6, T, 3, 2))
    gains = pc.design_gain(pc.LinearSystem(As, Bs), Q=Q, R=R)
    assert gains.shape == (T + 1, 2, 3)
    root_Q, root_R = np.linalg.cholesky(Q).T, np.linalg.cholesky(R).T
    for start in (0, 2):
        x, u = np.eye(3), np.zeros((3, 2 * T))  # x_t = x x_start + u [u_start; ...]
        rows, right = [], []
        for t in range(start, T):
            rows.append(root_R @ np.eye(2, 2 * T, 2 * (t - start)))
            right.append(np.zeros((2, 3)))
            u = As[t] @ u + Bs[t] @ np.eye(2, 2 * T, 2 * (t - start))
            x = As[t] @ x
            rows.append(root_Q @ u)
            right.append(-root_Q @ x)
        best = np.linalg.lstsq(np.vstack(rows), np.vstack(right), rcond=None)[0]
        assert_close(gains[start], -best[:2], 1e-10)
    assert_close(gains[T], np.zeros((2, 3)), 0, 0)


def test_designed_gain_of_a_long_constant_sequence_tends_to_the_stationary_one():
    gains = pc.design_gain(pc.LinearSystem(np.broadcast_to(A, (80, 3, 3)), B), Q=Q, R=R)
    assert_close(gains[0], riccati_gain(A, B, Q, R), 1e-10)


def test_designed_gain_of_a_diagonal_system_matches_the_dense_one():
    diagonal = pc.LinearSystem.diagonal([1.2, 0.5], [1.0, 0.3])
    dense = pc.LinearSystem(np.diag([1.2, 0.5]), np.diag([1.0, 0.3]))
    assert_close(pc.design_gain(diagonal, Q=np.eye(2), R=np.eye(2)), pc.design_gain(dense, Q=np.eye(2), R=np.eye(2)))


def design(Q=Q, R=R, A=A, B=B):
    return lambda: pc.design_gain(pc.LinearSystem(A, B), Q=Q, R=R)


DESIGNS_REFUSED = {
    "Q shape": (design(Q=np.eye(2)), "Q", "(2, 2)", "(3, 3)"),
    "R shape": (design(R=np.eye(3)), "R", "(3, 3)", "(2, 2)"),
    "indefinite Q": (design(Q=np.diag([1.0, -1.0, 1.0])), "Q", "semidefinite"),
    "singular R": (design(R=np.diag([1.0, 0.0])), "R", "positive definite"),
    "asymmetric R": (design(R=[[1.0, 0.5], [0.0, 1.0]]), "R", "symmetric"),
    "nan": (design(Q=np.full((3, 3), np.nan)), "Q", "nan"),
    "unreachable": (design(A=2 * np.eye(3), B=np.zeros((3, 2))), "system", "stabilisable"),
}


@pytest.mark.parametrize("case", DESIGNS_REFUSED.values(), ids=DESIGNS_REFUSED.keys())
def test_gain_design_is_refused_with_a_four_part_error(case):
    assert_refused(*case)


A_PUBLISHED = np.array([[0.7, 0.3, 0.2], [-0.2, 0.4, 0.5], [-0.4, 0.2, -0.3]])
B_PUBLISHED = np.array([[0.5, -0.3], [0.8, 0.3], [0.1, 0.9]])
DIRECTION = 0.1 * np.array([[2.0, 9.0, -6.0], [9.0, 9.0, 4.0], [-9.0, -2.0, 5.0]])
GAIN = -np.array([[-0.2130622, -0.34520195, -0.33427461], [0.39663286, -0.0863928, 0.14257925]])


def test_generalised_riccati_gain_matches_the_published_one():
    system = pc.LinearSystem(A_PUBLISHED, B_PUBLISHED)
    gain = pc.design_gain(system, Q=np.eye(3), R=np.eye(2), directions=[DIRECTION], variances=[0.1])
    np.testing.assert_allclose(gain, GAIN, atol=1e-8)
    plain = pc.design_gain(system, Q=np.eye(3), R=np.eye(2))
    none = pc.design_gain(system, Q=np.eye(3), R=np.eye(2), directions=[DIRECTION], variances=[0.0])
    np.testing.assert_allclose(none, plain, atol=1e-9)
    horizon = pc.LinearSystem(np.broadcast_to(A_PUBLISHED, (200, 3, 3)), B_PUBLISHED)
    first = pc.design_gain(horizon, Q=np.eye(3), R=np.eye(2), directions=[DIRECTION], variances=0.1)[0]
    np.testing.assert_allclose(first, GAIN, atol=1e-8)


def test_gain_design_says_when_multiplicative_noise_is_too_strong():
    system = pc.LinearSystem(A_PUBLISHED, B_PUBLISHED)
    with pytest.raises(pc.InputError, match="mean square"):
        pc.design_gain(system, Q=np.eye(3), R=np.eye(2), directions=[10 * DIRECTION], variances=[1.0])
    with pytest.raises(pc.InputError, match="directions"):
        pc.design_gain(system, Q=np.eye(3), R=np.eye(2), variances=[1.0])
    with pytest.raises(pc.InputError, match="non-negative"):
        pc.design_gain(system, Q=np.eye(3), R=np.eye(2), directions=[DIRECTION], variances=[-1.0])
