"""Averaged iterates: their definition, the covariance against closed forms and samples, the region's coverage."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import perfcontrol as pc
from perfcontrol.solvers.averaging import mean_field_jacobian
from tests.contracts.solver import SolverContract
from tests.solvers.problems import drifting, performative_prediction, steered, swapped
from tests.tools import assert_close, assert_refused

KEY = jax.random.key(5)


class TestAveragedRSGD(SolverContract):
    result_when_stopped = pc.Result.success

    def solver(self):
        return pc.RSGD(12, pc.PowerStep(0.01, 0.6), average=True)


def mapped(problem, solver, seeds, M0=None):
    """Solutions of so many seeds, with a leading axis; the history holds start and end alone."""
    run = jax.jit(jax.vmap(lambda key: pc.solve(problem, solver, M0, key=key, every=solver.steps)))
    return jax.tree.map(np.asarray, run(jax.random.split(KEY, seeds)))


def one(solutions, i):
    return jax.tree.map(lambda leaf: leaf[i], solutions)


# --- what is averaged ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("feasible_set", [None, pc.RowSum(0.2)])
def test_policy_is_the_mean_of_the_iterates_after_the_burn_in(feasible_set):
    problem = drifting(0, feasible_set)
    plain = pc.solve(problem, pc.RSGD(9, pc.PowerStep(0.01, 0.6)), key=KEY)
    averaged = pc.solve(problem, pc.RSGD(9, pc.PowerStep(0.01, 0.6), average=pc.Average(burn_in=0.4)), key=KEY)
    assert_close(averaged.history[:5], plain.history[:5], 1e-12)  # 0.4 of 9: three steps, and the first that counts
    assert_close(averaged.M, jnp.mean(plain.history[4:], axis=0), 1e-12)
    assert int(averaged.stats["averaged"]) == 6


def test_one_iterate_is_enough_to_average_where_derivatives_are_exact():
    problem = drifting(0)
    average = pc.Average(burn_in=0.9)
    averaged = pc.solve(problem, pc.RSGD(1, 0.01, average=average), key=KEY)
    assert int(averaged.stats["averaged"]) == 1
    assert_close(averaged.M, pc.solve(problem, pc.RSGD(1, 0.01), key=KEY).M, 1e-12)


def test_average_of_a_failed_run_is_finite_and_its_region_refused():
    problem = performative_prediction(0.5)
    solution = pc.solve(problem, pc.RSGD(100, 8.0, average=pc.Average(0.0)), key=KEY, throw=False)
    assert solution.result == pc.Result.diverged and bool(jnp.all(jnp.isfinite(solution.history)))
    assert_refused(lambda: pc.confidence_region(solution), "solution", "diverge", "have succeeded")


# --- covariance ------------------------------------------------------------------------------------------------------


def test_jacobian_of_the_mean_field_matches_central_differences():
    problem = steered()
    M = jnp.asarray([[[0.3, -0.2]]])
    J = np.asarray(mean_field_jacobian(problem, M))
    for j, unit in enumerate(np.eye(2).reshape(2, 1, 1, 2)):
        up, down = (pc.expected_gradient(problem, M + s * 1e-5 * unit) for s in (1, -1))
        assert_close(J[:, j], (up - down).ravel() / 2e-5, 1e-8)


def test_covariance_tends_to_the_sandwich_of_the_static_problem():
    N = 100_000
    solver = pc.RSGD(N, pc.PowerStep(0.5, 0.6), average=pc.Average(0.0))
    solution = pc.solve(swapped(0.7, 0.2), solver, key=KEY, every=N)
    covariance = N * np.asarray(solution.stats["covariance"])
    inverse = np.linalg.inv(np.array([[1.0, -0.7], [-0.2, 1.0]]))
    assert_close(covariance[np.ix_([0, 2], [0, 2])], inverse @ inverse.T, 0.04)
    assert_close(covariance[[1, 3]], np.zeros((2, 4)), 1e-12)  # the entries that the set holds at zero


def test_covariance_of_a_short_run_matches_the_dense_sum_over_its_noise():
    # e_{n+1} = (1 - η_n λ) e_n - η_n ξ_n: the average is Σ_n weight_n ξ_n, written out
    N, first, slope = 40, 10, 0.5
    problem = performative_prediction(0.5, deviation=1.0)
    solution = pc.solve(problem, pc.RSGD(N, pc.PowerStep(0.9, 0.7), average=True), [[[20.0]]], key=KEY)
    etas = 0.9 * np.arange(1.0, N + 1) ** -0.7
    weights = [
        sum(etas[n] * np.prod(1 - slope * etas[n + 1 : end + 1]) for end in range(max(first, n), N)) / (N - first)
        for n in range(N)
    ]
    plain = np.asarray(pc.solve(problem, pc.RSGD(N, pc.PowerStep(0.9, 0.7)), [[[20.0]]], key=KEY).history).ravel()
    gradients = (plain[:-1] - plain[1:]) / etas
    variance = np.mean(gradients[first:] ** 2)
    assert_close(solution.stats["covariance"], [[variance * np.sum(np.square(weights))]], 1e-10)
    left = np.cumprod(1 - slope * etas)[first:].mean()  # of the start
    assert_close(solution.stats["start_offset"], left * (20.0 - solution.M), 1e-10)


def test_covariance_by_batch_means_matches_the_batches_written_out():
    problem = performative_prediction(0.5, deviation=1.0)
    average = pc.Average(burn_in=0.25, covariance="batch means")
    solution = pc.solve(problem, pc.RSGD(300, 0.9, average=average), key=KEY)  # a short memory: 1 / 0.45 steps
    plain = np.asarray(pc.solve(problem, pc.RSGD(300, 0.9), key=KEY).history).ravel()
    means = plain[76:][: 22 * 10].reshape(22, 10).mean(axis=1)  # 225 iterates, 22 batches of 10
    away = means - means.mean()
    r = np.sum(away[1:] * away[:-1]) / np.sum(away**2)
    r = np.clip(r + (1 + 3 * r) / 22, 0, 0.9)
    assert int(solution.stats["batches"]) == 22
    assert_close(solution.stats["batch_correlation"], r, 1e-9)
    assert_close(solution.stats["covariance"], [[np.var(means, ddof=1) / 22 * (1 + r) / (1 - r)]], 1e-9)


def test_problem_without_moments_gets_batch_means():
    problem = steered()
    convex = pc.PerformativeProblem(
        system=problem.system,
        horizon=problem.horizon,
        noise=problem.noise,
        cost=pc.ConvexCost(lambda t, x, u: x @ x + 0.2 * u @ u),
        gain=problem.gain,
        perturbation=problem.perturbation,
    )
    solution = pc.solve(convex, pc.RSGD(80, 0.05, average=True), key=KEY)
    assert int(solution.stats["batches"]) == 24
    refused = pc.RSGD(80, 0.05, average=pc.Average(covariance="sandwich"))
    assert_refused(lambda: pc.solve(convex, refused, key=KEY), "covariance", "batch means")


def test_average_over_an_infinite_horizon_is_that_of_the_truncated_problem_per_stage():
    endless = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5]], [[1.0]]),
        horizon=float("inf"),
        noise=pc.Rademacher([1.0]),
        cost=pc.QuadraticCost([[1.0]], [[0.5]]),
        perturbation=pc.DirectionalPerturbation([[[0.2]]], pc.Affine([0.5], [[[[0.5]]]])),
    )
    cut = pc.solve(endless, pc.RSGD(40, 0.1, average=True, truncation=9), key=KEY)
    whole = pc.solve(endless.truncated(9), pc.RSGD(40, 0.01, average=True), key=KEY)
    assert_close(cut.M, whole.M, 1e-11)
    assert_close(cut.stats["covariance"], whole.stats["covariance"], 1e-10)


# --- the region ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def static_runs():
    """A thousand seeds of the static check at rho = 0.9."""
    return mapped(swapped(0.9), pc.RSGD(800, pc.PowerStep(1.0, 0.6), average=True), 1000)


def coverage(solutions, stable, level=0.95):
    count = len(solutions.M)
    share = np.mean([pc.confidence_region(one(solutions, i), level).contains(stable) for i in range(count)])
    print(f"region of level {level} covers in {share:.1%} of {count} runs")
    return share


def test_region_covers_the_stable_policy_of_the_static_check_as_often_as_it_says(static_runs):
    assert 0.92 <= coverage(static_runs, np.zeros((1, 2, 2))) <= 0.98
    assert 0.46 <= coverage(static_runs, np.zeros((1, 2, 2)), level=0.5) <= 0.54


def test_region_covers_the_stable_policy_of_a_control_problem_as_often_as_it_says():
    problem = steered()
    stable = pc.solve(problem, pc.StablePoint()).M
    solutions = mapped(problem, pc.RSGD(500, pc.PowerStep(0.1, 0.6), average=True), 1000)
    assert 0.92 <= coverage(solutions, stable) <= 0.98
    inside = [
        (r.lower <= stable) & (stable <= r.upper)
        for r in (pc.confidence_region(one(solutions, i)) for i in range(1000))
    ]
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.95) <= 0.03)


FAR = jnp.asarray([[[2.0, 0.0], [2.0, 0.0]]])  # along the direction that is slow to come back


@pytest.mark.slow
def test_region_covers_the_stable_policy_from_a_start_that_the_run_forgets():
    solver = pc.RSGD(3000, pc.PowerStep(0.5, 0.6, delay=20.0), average=True)
    assert 0.92 <= coverage(mapped(swapped(0.9), solver, 1000, FAR), np.zeros((1, 2, 2))) <= 0.98


@pytest.mark.slow
def test_region_covers_the_stable_policy_of_a_control_problem_with_twelve_parameters():
    problem = drifting(0)
    stable = pc.solve(problem, pc.StablePoint()).M
    solver = pc.RSGD(4000, pc.PowerStep(8e-4, 0.6, delay=230.0), average=True)
    assert 0.92 <= coverage(mapped(problem, solver, 1000), stable) <= 0.98


def test_offset_of_the_start_is_the_mean_error_and_refused_where_it_matters():
    solver = pc.RSGD(800, pc.PowerStep(1.0, 0.6), average=True)
    run = pc.solve(swapped(0.9), solver, 2 * FAR, key=KEY)
    assert_refused(lambda: pc.confidence_region(run), "solution", "feels its start", "delay")
    near = mapped(swapped(0.9), solver, 400, 1.5 * FAR)
    offset, deviation = np.mean(near.stats["start_offset"], axis=0), np.std(near.M, axis=0)
    assert_close(np.mean(near.M, axis=0)[0, :, 0], offset[0, :, 0], 4 * np.max(deviation) / 20 / np.max(offset))


def test_region_is_the_ellipsoid_of_the_covariance(static_runs):
    solution = one(static_runs, 0)
    region = pc.confidence_region(solution, 0.9)
    free = np.ix_([0, 2], [0, 2])
    precision = np.linalg.inv(np.asarray(solution.stats["covariance"])[free])
    quantile = scipy.stats.chi2.ppf(0.9, 2)
    lengths = np.linalg.norm(region.half_axes.reshape(2, 4), axis=1)
    assert_close(lengths, np.sqrt(quantile / np.linalg.eigvalsh(precision)), 1e-9)
    for axis in region.half_axes:
        offset = axis.reshape(4)[[0, 2]]
        assert_close(offset @ precision @ offset, quantile, 1e-9)
        assert region.contains(region.centre - 0.999 * axis) and not region.contains(region.centre + 1.001 * axis)
    assert not region.contains(region.centre + 1e-3 * np.eye(2)[None, ::-1])  # off the set, where nothing varies


def test_region_of_batch_means_uses_the_quantile_of_hotelling_and_student():
    problem = performative_prediction(0.5, deviation=1.0)
    solution = pc.solve(problem, pc.RSGD(300, 0.9, average=pc.Average(covariance="batch means")), key=KEY)
    region = pc.confidence_region(solution, 0.9)
    # with one parameter, Hotelling's quantile is the square of Student's
    student = scipy.stats.t.ppf(0.95, 21) * np.sqrt(float(solution.stats["covariance"][0, 0]))
    assert_close(abs(region.half_axes.ravel()), [student], 1e-9)
    assert_close(region.upper.ravel() - region.centre.ravel(), [student], 1e-9)


def test_steps_that_a_set_leaves_as_they_are_do_not_count_as_cut_short():
    wide = performative_prediction(0.5, feasible_set=pc.Box(-1000.0, 1000.0))
    run = pc.solve(wide, pc.RSGD(30, 0.1, average=True), key=KEY)
    assert int(run.stats["clipped"]) == 0 < float(jnp.sum(jnp.abs(run.M)))
    narrow = performative_prediction(0.5, feasible_set=pc.Box(-1.0, 1.0))
    cut = pc.solve(narrow, pc.RSGD(30, 0.1, average=True), key=KEY)
    assert int(cut.stats["clipped"]) == int(cut.stats["averaged"])


def test_region_is_refused_where_it_would_mislead():
    run = pc.solve(performative_prediction(0.5), pc.RSGD(30, 0.1, average=True), key=KEY)
    for level in (0.0, 1.0, "high"):
        assert_refused(lambda level=level: pc.confidence_region(run, level), "level", "between 0 and 1")
    plain = pc.solve(performative_prediction(0.5), pc.RSGD(30, 0.1), key=KEY)
    assert_refused(lambda: pc.confidence_region(plain), "solution", "average=True")
    short = pc.solve(performative_prediction(0.5), pc.RSGD(30, 0.1, average=True), key=KEY, max_steps=3)
    assert_refused(lambda: pc.confidence_region(short), "solution", "before its average began")
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), run)
    assert_refused(lambda: pc.confidence_region(stack), "solution", "one by one")
    edge = performative_prediction(0.5, feasible_set=pc.Box(-1.0, 1.0))  # the stable policy, 20, lies outside
    border = pc.solve(edge, pc.RSGD(30, 0.1, average=True), key=KEY)
    assert_refused(lambda: pc.confidence_region(border), "solution", "interior")
    crawl = pc.RSGD(100, 1e-3, average=pc.Average(covariance="batch means"))
    crawling = pc.solve(performative_prediction(0.5), crawl, key=KEY)
    assert_refused(lambda: pc.confidence_region(crawling), "solution", "resemble")
    near = pc.solve(performative_prediction(0.5), pc.RSGD(30, 0.1, average=True), [[[20.0]]], key=KEY)
    assert_refused(lambda: pc.confidence_region(near).contains([0.0]), "M", "(1, 1, 1)")


def test_average_refuses_settings_that_make_no_sense():
    assert_refused(lambda: pc.Average(1.0), "burn_in", "[0, 1)")
    assert_refused(lambda: pc.Average(covariance="hessian"), "covariance", "batch means")
    assert_refused(lambda: pc.RSGD(5, 0.1, average=3), "average", "pc.Average")
    momentum = SimpleNamespace(update=None)
    assert_refused(lambda: pc.RSGD(5, 0.1, average=True, transform=momentum), "transform", "plain steps")
    few = pc.RSGD(40, 0.1, average=pc.Average(covariance="batch means"))
    assert_refused(lambda: pc.solve(performative_prediction(0.5), few, key=KEY), "steps", "44")
    assert_refused(lambda: pc.PowerStep(0.0), "eta", "positive")
    assert_refused(lambda: pc.PowerStep(1.0, delay=0.0), "delay", "positive")
    for alpha in (0.5, 1.0):
        assert_refused(lambda alpha=alpha: pc.PowerStep(1.0, alpha), "alpha", "between 1/2 and 1")
