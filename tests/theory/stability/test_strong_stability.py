"""Strong stability against its definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import perfcontrol as pc


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), radius=st.floats(0.05, 0.99), skew=st.floats(0, 5))
def test_strong_stability_constants_satisfy_their_definition(seed, n, radius, skew):
    r = np.random.default_rng(seed)
    A = r.standard_normal((n, n))
    tilt = np.eye(n) + skew * np.triu(r.standard_normal((n, n)), 1)
    A = tilt @ A @ np.linalg.inv(tilt)
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    B, K = r.standard_normal((n, 2)), r.standard_normal((2, n))
    found = pc.strong_stability(pc.LinearSystem(A + B @ K, B), K, perturbation_bound=0.01)
    assert found.verified and found.reason == ""
    scale = np.linalg.norm(A, 2)
    np.testing.assert_allclose(found.Q @ found.L @ np.linalg.inv(found.Q), A, atol=1e-7 * max(1, scale))
    for norm in (np.linalg.norm(found.Q, 2), np.linalg.norm(np.linalg.inv(found.Q), 2), np.linalg.norm(K, 2)):
        assert norm <= found.kappa * (1 + 1e-9)
    assert np.linalg.norm(found.L, 2) <= 1 - found.gamma + 1e-9 and 0 < found.gamma <= 1 and found.kappa >= 1
    assert found.almost_surely is bool(found.factors.max() < 1)
    power = np.eye(n)
    for t in range(1, 30):
        power = power @ A
        assert np.linalg.norm(power, 2) <= found.kappa**2 * (1 - found.gamma) ** t * (1 + 1e-6) + 1e-12


def test_strong_stability_searches_the_rate_for_the_objective_it_is_given():
    A = np.array([[0.5, 3.0], [0.0, 0.6]])
    system, K = pc.LinearSystem(A, np.eye(2)), np.zeros((2, 2))
    slow = pc.strong_stability(system, K, objective=lambda s: s.kappa)
    fast = pc.strong_stability(system, K, objective=lambda s: -s.gamma)
    assert slow.kappa < fast.kappa and slow.gamma < fast.gamma


def test_stock_dynamics_are_not_strongly_stable_and_the_reason_is_said():
    problem = pc.experiments.stock_market("ascending", 1.0)
    found = pc.strong_stability(problem.system, problem.gain)
    assert not found.verified and "spectral radius 1" in found.reason


def test_strong_stability_of_a_time_varying_system_uses_one_transform():
    A = np.stack([0.5 * np.eye(2), [[0.4, 0.2], [0.0, 0.6]]])
    found = pc.strong_stability(pc.LinearSystem(A, np.eye(2)), np.zeros((2, 2)))
    assert found.verified and found.L.shape == (2, 2, 2)
    np.testing.assert_allclose(found.Q @ found.L @ np.linalg.inv(found.Q), A, atol=1e-10)


def test_strong_stability_refuses_bad_input():
    system = pc.LinearSystem(0.5 * np.eye(2), np.ones((2, 1)))
    with pytest.raises(pc.InputError, match="K"):
        pc.strong_stability(system, np.zeros((2, 2)))
    with pytest.raises(pc.InputError, match="negative"):
        pc.strong_stability(system, np.zeros((1, 2)), perturbation_bound=[-1.0])
