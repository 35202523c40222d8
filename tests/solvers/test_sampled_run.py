"""RRM, StablePoint and Continuation with sampled best responses: their reported error against exact stable policies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.solver import SolverContract
from tests.evaluate.cases import replaced
from tests.solvers.problems import DEVIATION, MEAN, drifting, performative_prediction, strongly_performative
from tests.tools import assert_refused, normal

FEW = pc.SampleAverage(64, 64)


def quadratic_stage(t, x, u):
    return x @ x + u @ u


def as_function(problem, function=quadratic_stage):
    """The problem with its quadratic cost written as a function."""
    return replaced(problem, cost=pc.ConvexCost(function))


class TestSampledStablePoint(SolverContract):
    close = (1e-7, 1e-2)  # ends of Newton's method

    def solver(self):
        return pc.StablePoint(1.0, 12, sampling=FEW)

    def problem(self, seed):
        return as_function(drifting(seed))


def within(solution, exact):
    return float(jnp.linalg.norm(solution.M - exact)) <= float(solution.stats["confidence_radius"])


@pytest.mark.parametrize("solver", [pc.RRM, pc.StablePoint, pytest.param(pc.Continuation, marks=pytest.mark.slow)])
def test_quadratic_written_as_a_function_reproduces_the_exact_stable_policy(solver):
    problem = drifting(0, pc.FrobeniusBall(0.3))
    exact = pc.solve(problem, pc.StablePoint()).M
    solution = pc.solve(as_function(problem), solver(0.03), key=jax.random.key(2))
    error = solution.stats["standard_error"]
    assert error.shape == exact.shape
    assert 0 < float(jnp.linalg.norm(error)) <= 0.03 * float(jnp.linalg.norm(solution.M))
    assert within(solution, exact)


def test_stable_policy_at_which_repeated_minimisation_runs_away_is_found_by_samples():
    problem = strongly_performative()
    exact = pc.solve(problem, pc.StablePoint()).M
    solution = pc.solve(as_function(problem), pc.StablePoint(0.1), key=jax.random.key(1))
    assert within(solution, exact)
    ended = pc.solve(as_function(problem), pc.RRM(0.1, max_steps=20), key=jax.random.key(1), throw=False)
    assert ended.result != pc.Result.success


@pytest.mark.parametrize("sensitivity", [0.8, -3.0], ids=["contracts slowly", "expands"])
def test_reported_error_of_performative_prediction_is_its_closed_form(sensitivity):
    """Φ_N(M) = z̄ + sensitivity M for the mean z̄ of N signs of size 0.1, amplified by 1 / (1 - sensitivity)."""

    def last_stage(t, x, u):
        return jnp.where(t == 2, 0.5, 0.0) * x[0] ** 2

    problem = as_function(performative_prediction(sensitivity), last_stage)
    solution = pc.solve(problem, pc.StablePoint(), key=jax.random.key(6))
    expected = DEVIATION / np.sqrt(float(solution.stats["samples"])) / (1 - sensitivity)
    assert float(solution.stats["standard_error"][0, 0, 0]) == pytest.approx(expected, rel=0.02)
    assert float(solution.stats["confidence_radius"]) == pytest.approx(1.96 * expected, rel=0.03)
    assert abs(float(solution.M[0, 0, 0]) - MEAN / (1 - sensitivity)) <= 3 * expected


def test_sample_grows_until_the_error_meets_the_tolerance_and_says_so_where_it_may_not():
    problem, key = as_function(drifting(0, pc.FrobeniusBall(0.3))), jax.random.key(3)
    sizes = []
    for tolerance in (0.1, 0.04):
        solution = pc.solve(problem, pc.StablePoint(tolerance, sampling=pc.SampleAverage(128)), key=key)
        relative = float(jnp.linalg.norm(solution.stats["standard_error"]) / jnp.linalg.norm(solution.M))
        assert relative <= tolerance
        sizes.append(int(solution.stats["samples"]))
    assert 128 < sizes[0] < sizes[1]
    short = pc.solve(problem, pc.StablePoint(0.04, sampling=pc.SampleAverage(128, 512)), key=key, throw=False)
    assert short.result == pc.Result.undersampled and short.stats["samples"] == 512
    assert float(jnp.linalg.norm(short.stats["standard_error"])) > 0.04 * float(jnp.linalg.norm(short.M))
    with pytest.raises(pc.SolveError, match="SampleAverage"):
        pc.solve(problem, pc.StablePoint(0.04, sampling=pc.SampleAverage(128, 512)), key=key)


def probabilities(M):
    moved = 0.3 * jnp.tanh(jnp.sum(M))
    return jnp.stack([0.5 + moved, 0.5 - moved])


@pytest.mark.parametrize(
    "perturbation",
    [
        pc.FinitePerturbation(0.3 * normal(6, 2, 3, 3), probabilities),
        pc.SampledPerturbation(lambda key, M: 0.3 * jnp.tanh(jnp.sum(M)) * jax.random.normal(key, (6, 3, 3), M.dtype)),
    ],
    ids=["finite", "sampled"],
)
def test_stable_policies_without_moments_or_smooth_draws_have_a_small_gap_in_fresh_paths(perturbation):
    """The best response to the answer, on other paths, is the answer up to the two errors."""
    problem = replaced(drifting(0, pc.FrobeniusBall(0.3)), perturbation=perturbation)
    if isinstance(perturbation, pc.FinitePerturbation):
        exact = pc.solve(problem, pc.StablePoint()).M
        assert within(pc.solve(as_function(problem), pc.StablePoint(0.05), key=jax.random.key(4)), exact)
        return
    solution = pc.solve(problem, pc.StablePoint(0.05), key=jax.random.key(4))
    again = pc.estimate_response(problem, solution.M, key=jax.random.key(5), tolerance=0.05)
    errors = [float(jnp.linalg.norm(e)) for e in (again.standard_error, solution.stats["standard_error"])]
    assert float(jnp.linalg.norm(again.mean - solution.M)) <= 2.5 * np.sqrt(errors[0] ** 2 + errors[1] ** 2)


def test_key_changes_nothing_where_best_responses_are_exact():
    problem = drifting(0)
    with_key = pc.solve(problem, pc.StablePoint(), key=jax.random.key(0))
    np.testing.assert_array_equal(with_key.M, pc.solve(problem, pc.StablePoint()).M)
    assert "standard_error" not in with_key.stats


@pytest.mark.parametrize("solver", [pc.RRM(), pc.StablePoint()], ids=["rrm", "stable"])
def test_a_cost_that_is_not_convex_is_refused_with_the_point(solver):
    saddle = as_function(drifting(0), lambda t, x, u: x @ x - u @ u)
    assert_refused(
        lambda: pc.solve(saddle, solver, key=jax.random.key(0)), "function", "eigenvalue -2", "x = [", "u = ["
    )


@pytest.mark.slow
@pytest.mark.parametrize("feasible_set", [None, pc.FrobeniusBall(0.3)], ids=["free", "ball"])
def test_reported_radius_covers_the_exact_stable_policy_at_its_level(feasible_set):
    """100 seeds: of 95 % confidence, 90 to 99 are what a fair radius covers but in one case of a hundred. On the ball,
    where the constraint holds the error down, the radius is wider than it need be: all of them."""
    problem = drifting(0, feasible_set)
    exact = pc.solve(problem, pc.StablePoint()).M
    solver, convex = pc.StablePoint(0.05), as_function(problem)
    covered = sum(within(pc.solve(convex, solver, key=jax.random.key(seed)), exact) for seed in range(100))
    print(f"covered: {covered} of 100")
    assert 90 <= covered <= (99 if feasible_set is None else 100)
