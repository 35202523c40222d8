"""Infinite horizons: the average cost per stage against dense moments, long horizons, LQR and simulation."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate import lyapunov
from perfcontrol.evaluate.stationary import mean_square_radius
from tests.evaluate.endless import (
    CROSS,
    DEPLOYED,
    U_TARGET,
    W_COVARIANCE,
    W_MEAN,
    X_TARGET,
    A,
    B,
    D,
    H,
    K,
    M,
    Q,
    R,
    everything,
    m,
    n,
    offset,
    scales,
)
from tests.oracles.lqr import generalised_riccati_gain, infinite_horizon_cost
from tests.oracles.stationary import stationary_cost
from tests.tools import assert_close, assert_refused, central_differences, normal, random_psd, tolerance


def oracle(M, deployed, mean=W_MEAN):
    weight = np.block([[np.asarray(Q), np.asarray(CROSS)], [np.asarray(CROSS).T, np.asarray(R)]])
    target = np.concatenate([X_TARGET, U_TARGET])
    data = [np.asarray(part, dtype=float) for part in (A, B, K, M, mean, W_COVARIANCE, weight)]
    cost_terms = -weight @ target, target @ weight @ target
    variances = np.asarray(scales(jnp.asarray(deployed))) ** 2
    return stationary_cost(*data, *cost_terms, np.asarray(D), variances, np.asarray(offset(jnp.asarray(deployed))))


@pytest.mark.float32
def test_expected_cost_matches_dense_moments_of_the_extended_state():
    assert_close(pc.expected_cost(everything(), M, deployed=DEPLOYED), oracle(M, DEPLOYED)[0], 1e-12, 2e-4)


@pytest.mark.float32
def test_spectral_radius_matches_that_of_the_dense_operator():
    assert_close(mean_square_radius(everything(), DEPLOYED), oracle(M, DEPLOYED)[1], 1e-3, 2e-3)


def test_gradients_match_central_differences_of_dense_moments():
    problem = everything()
    by_policy = central_differences(lambda M: oracle(M, DEPLOYED)[0], M, 1e-3)
    assert_close(pc.expected_gradient(problem, M, deployed=DEPLOYED), by_policy, 1e-9)
    total = central_differences(lambda M: oracle(M, M)[0], M, 1e-5)
    assert_close(pc.expected_gradient(problem, M, total=True), total, 1e-7)


def test_best_response_has_no_gradient_and_differentiates_in_the_deployed_policy():
    problem = everything()
    response = pc.best_response(problem, DEPLOYED)
    scale = jnp.linalg.norm(pc.expected_gradient(problem, 0 * M, deployed=DEPLOYED))
    assert jnp.linalg.norm(pc.expected_gradient(problem, response, deployed=DEPLOYED)) <= 1e-12 * scale
    assert pc.residual(problem, response, deployed=DEPLOYED) <= 1e-12
    along = normal(15, H, m, n)
    _, slope = jax.jvp(lambda deployed: pc.best_response(problem, deployed), (DEPLOYED,), (along,))
    step = 1e-5
    ahead, behind = (pc.best_response(problem, DEPLOYED + sign * step * along) for sign in (1, -1))
    assert_close(slope, (ahead - behind) / (2 * step), 1e-7)


def test_long_horizons_come_near_like_one_over_their_length():
    endless = everything()
    stable = pc.solve(endless, pc.StablePoint()).M
    cost = pc.expected_cost(endless, M, deployed=DEPLOYED)
    gradient = pc.expected_gradient(endless, M, deployed=DEPLOYED)
    gaps = []
    for T in (200, 2000):
        finite = endless.truncated(T)
        by_cost = pc.expected_cost(finite, M, deployed=DEPLOYED) / T - cost
        by_gradient = pc.expected_gradient(finite, M, deployed=DEPLOYED) / T - gradient
        by_policy = pc.solve(finite, pc.StablePoint()).M - stable
        gaps.append(np.concatenate([by_cost[None], by_gradient.ravel(), by_policy.ravel()]))
    assert 0 < np.abs(gaps[0]).max() <= 0.2
    assert_close(10 * gaps[1], gaps[0], 0.01)


def test_start_has_no_influence():
    far = everything(initial_state=pc.Gaussian(100 * np.ones(n), np.eye(n)))
    assert float(pc.expected_cost(far, M)) == float(pc.expected_cost(everything(), M))


def test_optimum_approaches_the_lqr_of_python_control_as_the_memory_grows():
    """Ten systems without reaction around a gain that is not optimal."""
    control = pytest.importorskip("control")
    for seed in range(10):
        rng = np.random.default_rng(seed)
        A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
        A = 0.95 * A / np.max(np.abs(np.linalg.eigvals(A)))
        Q, R, covariance = (np.asarray(random_psd(seed + s, size)) for s, size in ((0, n), (50, m), (90, n)))
        gain, P, _ = control.dlqr(A, B, Q, R)
        gaps = []
        for memory in (1, 4, 16):
            problem = pc.PerformativeProblem(
                system=pc.LinearSystem(A, B),
                horizon=math.inf,
                memory=memory,
                gain=0.7 * gain,
                noise=pc.Gaussian(np.zeros(n), covariance),
                cost=pc.QuadraticCost(Q, R),
            )
            best = pc.best_response(problem, np.zeros((memory, m, n)))
            gaps.append(float(pc.expected_cost(problem, best)) / np.trace(P @ covariance) - 1)
        assert gaps[0] >= gaps[1] >= gaps[2] >= -1e-12, gaps
        assert gaps[2] <= 1e-3, gaps


def test_published_cost_of_multiplicative_noise_is_met_per_stage():
    """Gravell et al. (2019): noise of identity covariance costs per stage what one start of that covariance costs."""
    A = np.array([[0.7, 0.3, 0.2], [-0.2, 0.4, 0.5], [-0.4, 0.2, -0.3]])
    B = np.array([[0.5, -0.3], [0.8, 0.3], [0.1, 0.9]])
    directions = 0.1 * np.array([[[2.0, 9, -6], [9, 9, 4], [-9, -2, 5]]])
    gain = generalised_riccati_gain(A, B, directions, [0.1], np.eye(3), np.eye(2))
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=math.inf,
        gain=gain,
        noise=pc.Rademacher(np.ones(3)),
        cost=pc.QuadraticCost(np.eye(3), np.eye(2)),
        perturbation=pc.DirectionalPerturbation(directions, [math.sqrt(0.1)]),
    )
    cost = pc.expected_cost(problem, np.zeros((1, 2, 3)))
    assert_close(cost, infinite_horizon_cost(A, B, gain, directions, [0.1], np.eye(3), np.eye(2))[0], 1e-12)
    assert float(cost) == pytest.approx(4.858605014, abs=1e-8)


def test_diagonal_systems_cost_what_dense_ones_do():
    a, b = 0.8 * np.tanh(normal(20, n)), normal(21, n)
    policy = 0.3 * normal(22, 2, n, n)

    def problem(system):
        return pc.PerformativeProblem(
            system=system,
            horizon=math.inf,
            memory=2,
            noise=pc.Gaussian(W_MEAN, W_COVARIANCE),
            cost=pc.QuadraticCost(Q, np.eye(n), state_target=X_TARGET),
        )

    quick, dense = problem(pc.LinearSystem.diagonal(a, b)), problem(pc.LinearSystem(np.diag(a), np.diag(b)))
    assert_close(pc.expected_cost(quick, policy), pc.expected_cost(dense, policy))
    assert_close(pc.best_response(quick, policy), pc.best_response(dense, policy), 1e-11)


@pytest.mark.float32
def test_deployed_policy_that_is_not_mean_square_stable_is_refused_with_its_spectral_radius():
    problem, wild = everything(), 8 * M
    radius = oracle(M, wild)[1]
    assert radius > 1
    for call in (pc.expected_cost, pc.expected_gradient, pc.residual):
        assert_refused(
            lambda call=call: call(problem, M, deployed=wild), "deployed", "mean-square stable", f"{radius:.2f}"[:3]
        )
    assert_refused(lambda: pc.best_response(problem, wild), "deployed", "spectral radius")
    assert_refused(lambda: pc.expected_gradient(problem, wild, total=True), "deployed", "spectral radius")
    assert math.isfinite(pc.expected_cost(problem, wild, deployed=M))  # evaluated, it does no harm


def test_boundary_of_mean_square_stability_is_where_the_scalar_radius_passes_one():
    """a² + σ² = 1 with a = 0.6, σ = 0.8 |M|: refused from |M| = 1 on, though a alone is stable."""
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.6]], [[1.0]]),
        horizon=math.inf,
        noise=pc.Rademacher([1.0]),
        cost=pc.QuadraticCost([[1.0]], [[1.0]]),
        perturbation=pc.DirectionalPerturbation([[[1.0]]], pc.Affine([0.0], [[[[0.8]]]])),
    )
    close = 1 - 1e-6
    expected = 1 / (0.64 * (1 - close**2))  # Λ = 1 / (1 - 0.36 - 0.64 M²), and no policy acts
    cost = pc.expected_cost(problem, [[[0.0]]], deployed=[[[close]]])
    assert_close(cost, expected, 1e-9)
    for beyond in (1 + 1e-9, 1.5, -3.0):
        assert_refused(lambda beyond=beyond: pc.expected_cost(problem, [[[0.0]]], deployed=[[[beyond]]]), "deployed")


def test_unstable_worlds_are_nan_under_a_trace_beside_stable_ones():
    problem = everything()
    worlds = jnp.stack([DEPLOYED, 8 * M, 0.5 * M])
    costs = jax.jit(jax.vmap(lambda deployed: pc.expected_cost(problem, M, deployed=deployed)))(worlds)
    assert jnp.isnan(costs).tolist() == [False, True, False]
    assert_close(costs[0], oracle(M, DEPLOYED)[0])


def test_large_states_are_solved_by_the_series_alike(monkeypatch):
    problem = everything()
    cost, gradient = pc.expected_cost(problem, M), pc.expected_gradient(problem, M, total=True)
    monkeypatch.setattr(lyapunov, "DENSE", 0)
    jax.clear_caches()
    assert_close(pc.expected_cost(problem, M), cost, 1e-12)
    assert_close(pc.expected_gradient(problem, M, total=True), gradient, 1e-11)
    assert_refused(lambda: pc.expected_cost(problem, 8 * M), "deployed", "spectral radius")
    jax.clear_caches()


def test_simulation_needs_a_truncation_and_then_costs_what_the_truncated_problem_does():
    endless, T, key = everything(), 40, jax.random.key(0)
    finite = endless.truncated(T)
    assert eqx.tree_equal(everything(T), finite)
    settings = {"deployed": DEPLOYED, "key": key, "samples": 3}
    for call in (pc.simulate, pc.estimate_cost, pc.sample_gradient):
        assert_refused(lambda call=call: call(endless, M, **settings), "truncation", "None")
        assert_refused(lambda call=call: call(finite, M, **settings, truncation=9), "truncation", "40")
    cut = pc.simulate(endless, M, **settings, truncation=T)
    assert_close(cut.cost, pc.simulate(finite, M, **settings).cost / (T + 1))
    estimate, whole = pc.estimate_cost(endless, M, **settings, truncation=T), pc.estimate_cost(finite, M, **settings)
    assert_close(estimate.mean, whole.mean / (T + 1))
    assert_close(estimate.standard_error, whole.standard_error / (T + 1))
    gradient = pc.sample_gradient(finite, M, **settings)
    assert_close(pc.sample_gradient(endless, M, **settings, truncation=T), gradient / (T + 1))
    assert_close(pc.path_gradient(endless, cut), gradient)


def test_simulated_average_lies_within_five_standard_errors_of_the_exact_one():
    problem = everything()
    estimate = pc.estimate_cost(problem, M, deployed=DEPLOYED, key=jax.random.key(1), samples=200, truncation=2000)
    exact = pc.expected_cost(problem, M, deployed=DEPLOYED)
    bias = abs(float(pc.expected_cost(problem.truncated(2000), M, deployed=DEPLOYED)) / 2001 - float(exact))
    assert bias <= 0.01 * float(exact)
    assert abs(float(estimate.mean - exact)) <= 5 * float(estimate.standard_error) + bias


def test_time_varying_data_are_refused():
    def tall(part, length=5):
        return np.broadcast_to(part, (length, *np.shape(part)))

    refused = {
        "system": lambda: everything(system=pc.LinearSystem(tall(A), B)),
        "gain": lambda: everything(gain=tall(K)),
        "Q": lambda: everything(cost=pc.QuadraticCost(tall(Q), R)),
        "state_target": lambda: everything(cost=pc.QuadraticCost(Q, R, state_target=tall(X_TARGET, 1))),
        "noise": lambda: everything(noise=pc.Sequence(tall(W_MEAN))),
        "discount": lambda: everything(cost=pc.QuadraticCost(Q, R, discount=0.9)),
    }
    for name, build in refused.items():
        assert_refused(build, name, "horizon is infinite")
    for length in (1, 2, 5):
        scale = tall(np.ones(2), length)
        law = pc.DirectionalPerturbation(D, scale)
        assert_refused(lambda law=law: everything(perturbation=law), "perturbation", "horizon is infinite")
    drawn = pc.SampledPerturbation(lambda key, M: jnp.zeros((4, n, n)))
    assert_refused(lambda: everything(perturbation=drawn), "perturbation", "horizon is infinite")
    wrong = pc.DirectionalPerturbation(D[:, :, :2], np.ones(2))
    assert_refused(lambda: everything(perturbation=wrong), "directions")  # nothing to do with time
    for horizon in (-math.inf, math.nan, 2.5):
        assert_refused(lambda horizon=horizon: everything(horizon), "horizon")


def test_moments_along_time_ask_for_a_finite_horizon():
    for call in (pc.state_moments, pc.expected_cost_by_moments):
        assert_refused(lambda call=call: call(everything(), M), "problem", "truncated")


def test_unknown_moments_and_other_costs_are_refused_as_on_finite_horizons():
    smooth = everything(cost=pc.ConvexCost(lambda t, x, u: jnp.sum(x**2) + jnp.sum(u**2)))
    assert_refused(lambda: pc.expected_cost(smooth, M), "cost")
    assert tolerance(1, 1) and pc.simulate(smooth, M, key=jax.random.key(0), truncation=9).cost.shape == (1,)
