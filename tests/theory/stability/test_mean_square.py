"""The mean-square analysis against enumeration, bisection, simulation and the published figure."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory.stability.mean_square import leading_eigenvalue
from perfcontrol.theory.stability.safe_step import mean_square_stability
from tests.theory.problems import prediction_problem, random_problem


def test_prediction_mean_square_analysis_matches_its_closed_form():
    """The noise of the data is additive: threshold 2/(1-ε), floor η²σ²/(1 - (1-η(1-ε))²)."""
    stability = mean_square_stability(prediction_problem(0.5, deviation=0.3), samples=64)
    assert stability.threshold_estimate == pytest.approx(4.0, rel=1e-6)
    exact = 0.5**2 * 0.3**2 / (1 - (1 - 0.5 * 0.5) ** 2)
    assert stability.error_floor(0.5) == pytest.approx(exact, rel=0.15)  # the gradient's variance is sampled
    assert stability.spectral_radius(1.0) == pytest.approx(0.25, rel=1e-6)


def enumerated_problem():
    """Scalar, T = 3, Δ and w Rademacher: 64 equally likely paths; D does not depend on the policy."""
    one = np.ones((1, 1))
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.8 * one, one),
        horizon=3,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(one, 0.5 * one),
        perturbation=pc.DirectionalPerturbation([one], np.array([0.5])),
        initial_state=[1.0],
    )


def test_threshold_matches_enumeration_of_every_path_where_the_law_is_fixed():
    """Scalar policy: 𝓛 is the number E(1 - η𝒥)², stable iff η < 2 E𝒥 / E𝒥²; 𝒥 by hand on all 64 paths."""
    jacobians = []
    for signs in itertools.product([-1, 1], repeat=6):
        w, delta = signs[:3], np.array(signs[3:]) * 0.5
        response = 0.0
        curvature = 0.0
        for t in range(4):
            by_u = w[t - 1] if t else 0.0
            curvature += 2 * response**2 + 2 * 0.5 * by_u**2
            if t < 3:
                response = (0.8 + delta[t]) * response + by_u
        jacobians.append(curvature)
    exact = 2 * np.mean(jacobians) / np.mean(np.square(jacobians))
    stability = mean_square_stability(enumerated_problem(), samples=4096)
    assert abs(stability.threshold_estimate - exact) < 5 * stability.standard_error
    assert stability.standard_error < 0.02 * exact
    batched = mean_square_stability(enumerated_problem(), samples=4096, batch=4)
    mean, square = np.mean(jacobians), np.mean(np.square(jacobians))
    assert batched.threshold_estimate == pytest.approx(2 * mean / (square / 4 + 0.75 * mean**2), rel=0.02)
    assert batched.spectral_radius(batched.threshold_estimate) == pytest.approx(1.0, abs=0.02)


def test_threshold_by_one_eigenvalue_matches_bisection_on_the_spectral_radius():
    problem = random_problem(3, bounded=False, strength=0.2)
    stability = mean_square_stability(problem, samples=2048)
    low, high = 0.0, 3 * stability.threshold_estimate
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if stability.spectral_radius(middle, 1e-8) < 1 else (low, middle)
    assert low == pytest.approx(stability.threshold_estimate, abs=4 * stability.standard_error)
    X = stability.stationary_covariance(low / 3)
    step = low / 3
    np.testing.assert_allclose(
        X, stability.operator(step)(X) + step**2 * stability.gradient_covariance, rtol=1e-4, atol=1e-6 * np.abs(X).max()
    )


@pytest.mark.slow
def test_error_floor_matches_simulation_at_a_safe_step():
    problem = random_problem(3, bounded=False, strength=0.05)
    M = pc.solve(problem, pc.StablePoint()).M
    stability = mean_square_stability(problem, M, samples=1024)
    step = stability.threshold_estimate / 20
    solver = pc.RSGD(1500, step)
    keys = jax.random.split(jax.random.key(5), 16)

    def one(key):
        record = pc.solve(problem, solver, M, key=key, record=lambda N: jnp.sum((N - M) ** 2)).history
        return jnp.mean(record[300:])

    errors = np.asarray(jax.lax.map(one, keys))
    spread = errors.std(ddof=1) / 4
    assert errors.mean() == pytest.approx(stability.error_floor(step), abs=5 * spread + 0.1 * errors.mean())


def test_leading_eigenvalue_matches_a_dense_kronecker_operator():
    r = np.random.default_rng(0)
    maps = r.standard_normal((3, 4, 4))
    value, _ = leading_eigenvalue(lambda X: sum(J @ X @ J.T for J in maps), 4, 1e-12, 5000)
    dense = sum(np.kron(J, J) for J in maps)
    assert value == pytest.approx(np.abs(np.linalg.eigvals(dense)).max(), rel=1e-9)


STOCK_THRESHOLDS = {"ascending": 0.0240, "random": 0.0090, "descending": 0.0046}


@pytest.mark.slow
def test_stock_threshold_predicts_which_orders_diverge_at_the_papers_step():
    problem = pc.experiments.stock_market("descending", 1.0)
    stability = mean_square_stability(problem, samples=192)
    threshold, error = (60 * value for value in (stability.threshold_estimate, stability.standard_error))
    assert threshold == pytest.approx(STOCK_THRESHOLDS["descending"], abs=4 * error)
    assert threshold < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("order", STOCK_THRESHOLDS)
def test_stock_thresholds_match_the_published_figure(order):
    problem = pc.experiments.stock_market(order, 1.0)
    stability = mean_square_stability(problem, samples=2048)
    threshold, error = (60 * value for value in (stability.threshold_estimate, stability.standard_error))
    assert threshold == pytest.approx(STOCK_THRESHOLDS[order], abs=4 * error)
    assert (threshold < 0.01) is (order != "ascending")
