"""Without reaction the package is classical control: hindsight least squares, and the LQR limit of long memories."""

import numpy as np
import pytest
import scipy.linalg

import perfcontrol as pc
from tests.oracles.enumeration import Paths, simulate
from tests.tools import assert_close, normal, random_psd


def test_stable_policy_of_a_recorded_disturbance_is_the_least_squares_policy_in_hindsight():
    """States and inputs are affine in M on the one path that there is: an ordinary regression."""
    T, n, m, H = 20, 3, 2, 3
    A, B, K = 0.5 * normal(1, n, n), normal(2, n, m), 0.1 * normal(3, m, n)
    Q, R, w, start = random_psd(4, n), random_psd(5, m), normal(6, T, n), normal(7, n)
    target = normal(8, T + 1, n)
    path = Paths(np.ones(1), np.asarray(start)[None], np.asarray(w)[None], np.zeros((1, T, n, n)))
    tiled = [np.broadcast_to(X, (length, *X.shape)) for X, length in ((A, T), (B, T), (K, T + 1))]
    x, u, dx, du = (part[0] for part in simulate(*tiled, np.zeros((H, m, n)), path))
    roots = scipy.linalg.cholesky(Q), scipy.linalg.cholesky(R)  # upper: Q = rootᵀ root
    rows = [
        np.einsum("ab,tb...->ta...", root, slope).reshape(-1, H * m * n)
        for root, slope in zip(roots, (dx, du), strict=True)
    ]
    wanted = [-((x - np.asarray(target)) @ roots[0].T).reshape(-1), -(u @ roots[1].T).reshape(-1)]
    hindsight = np.linalg.lstsq(np.concatenate(rows), np.concatenate(wanted), rcond=None)[0].reshape(H, m, n)

    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=T,
        memory=H,
        gain=K,
        noise=pc.Sequence(w),
        cost=pc.QuadraticCost(Q, R, state_target=target),
        initial_state=start,
    )
    solution = pc.solve(problem, pc.StablePoint())
    assert_close(solution.M, hindsight, 1e-9)
    assert bool(solution.stats["unique"])


def test_optimum_approaches_the_lqr_of_python_control_as_the_memory_grows():
    """Ten systems around any stabilising gain: cost to that of dlqr, the first lag to its feedback."""
    control = pytest.importorskip("control")
    T, n, m = 150, 3, 2
    for seed in range(10):
        rng = np.random.default_rng(seed)
        A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
        A = 0.95 * A / np.max(np.abs(np.linalg.eigvals(A)))
        Q, R = np.asarray(random_psd(seed, n)), np.asarray(random_psd(seed + 50, m))
        gain, P, _ = control.dlqr(A, B, Q, R)
        start = 0.7 * gain  # a stabilising gain that is not optimal
        assert np.max(np.abs(np.linalg.eigvals(A - B @ start))) < 1

        def problem(memory, K, A=A, B=B, Q=Q, R=R):
            return pc.PerformativeProblem(
                system=pc.LinearSystem(A, B),
                horizon=T,
                memory=memory,
                gain=K,
                noise=pc.Rademacher(np.ones(n)),
                cost=pc.QuadraticCost(Q, R),
            )

        optimal = float(pc.expected_cost(problem(1, gain), np.zeros((1, m, n))))
        assert optimal == pytest.approx(T * np.trace(P), rel=0.2)  # that of infinite time, but for the ends
        gaps = []
        for memory in (1, 3, 10):
            M = pc.best_response(problem(memory, start), np.zeros((memory, m, n)))
            gaps.append(float(pc.expected_cost(problem(memory, start), M)) / optimal - 1)
        assert gaps[0] >= gaps[1] >= gaps[2], gaps
        assert abs(gaps[2]) <= 2e-3, gaps
        assert np.linalg.norm(np.asarray(M[0]) - (start - gain)) <= 0.05 * np.linalg.norm(gain)
