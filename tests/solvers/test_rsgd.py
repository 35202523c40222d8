"""Repeated stochastic gradient descent: its definition step by step, published errors, convergence, failures."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.solver import SolverContract
from tests.oracles.performative_prediction import published_step_size, squared_errors, stable_decision
from tests.solvers.problems import MEAN, drifting, performative_prediction
from tests.tools import assert_close, assert_mean_is, assert_refused

KEY = jax.random.key(11)


class TestRSGD(SolverContract):
    result_when_stopped = pc.Result.success

    def solver(self):
        return pc.RSGD(12, pc.InverseStep(0.1, 10), batch=2)

    def test_solver_refuses_a_missing_key(self):
        assert_refused(lambda: pc.solve(self.problems[0], self.solver()), "key", "jax.random.key(0)")


# --- the definition, step by step ------------------------------------------------------------------------------------


def by_hand(problem, steps, step_size, *, batch=1, deploy_every=1) -> list[np.ndarray]:
    """Algorithm 1 in Python."""
    free = drifting(0)  # the gradient does not know the set
    M = deployed = problem.initial_policy()
    iterates = [M]
    for n in range(steps):
        deployed = M if n % deploy_every == 0 else deployed
        key = jax.random.fold_in(KEY, n)
        gradient = pc.sample_gradient(free, M, deployed=deployed, key=key, samples=batch)
        M = problem.feasible_set.project(M - step_size(n) * gradient)
        iterates.append(M)
    return iterates


@pytest.mark.float32
@pytest.mark.parametrize(
    ("feasible_set", "batch"),
    [(pc.RowSum(0.7), 3), (pc.FrobeniusBall(0.2), 1)],
    ids=lambda value: type(value).__name__ if isinstance(value, pc.AbstractSet) else f"batch{value}",
)
def test_rsgd_iterates_match_projected_sample_gradient_steps(feasible_set, batch):
    problem = drifting(0, feasible_set)
    history = pc.solve(problem, pc.RSGD(4, pc.InverseStep(0.05, 5), batch=batch), key=KEY).history
    assert_close(history, jnp.stack(by_hand(problem, 4, lambda n: 0.05 / (n + 5), batch=batch)), 1e-11, 1e-4)
    for M in history:
        assert bool(feasible_set.contains(M, 1e-6))


def test_rsgd_takes_gradients_in_the_world_of_the_last_deployed_iterate_when_lazy():
    problem = drifting(0)
    solution = pc.solve(problem, pc.RSGD(7, 0.002, schedule=pc.Lazy(3)), key=KEY)
    assert_close(solution.history, jnp.stack(by_hand(problem, 7, lambda n: 0.002, deploy_every=3)), 1e-11)
    assert int(solution.stats["deployments"]) == 3  # at n = 0, 3, 6
    assert int(pc.solve(problem, pc.RSGD(7, 0.002), key=KEY).stats["deployments"]) == 7


class Momentum(NamedTuple):
    """What optax calls `trace`, as small as it gets."""

    decay: float

    def init(self, M):
        return jnp.zeros_like(M)

    def update(self, gradient, state, M):
        state = self.decay * state + gradient
        return state, state


def test_rsgd_applies_the_gradient_transformation_before_the_step():
    problem = drifting(0)
    history = pc.solve(problem, pc.RSGD(4, 0.02, gradient=pc.Exact(), transform=Momentum(0.8))).history
    M, velocity = problem.initial_policy(), 0.0
    for n in range(4):
        velocity = 0.8 * velocity + pc.expected_gradient(problem, M)
        M = M - 0.02 * velocity
        assert_close(history[n + 1], M, 1e-11)


def test_rsgd_refuses_settings_that_make_no_sense():
    assert_refused(lambda: pc.RSGD(0, 0.1), "steps", "at least 1")
    assert_refused(lambda: pc.RSGD(2.5, 0.1), "steps", "integer")
    assert_refused(lambda: pc.RSGD(5, 0.1, batch=0), "batch", "at least 1")


# --- published numbers: performative prediction ----------------------------------------------------------------------


@pytest.mark.parametrize("sensitivity", [0.9, 1.5, -0.5])
def test_mean_field_error_matches_the_exact_recursion(sensitivity):
    problem = performative_prediction(sensitivity)
    history = pc.solve(problem, pc.RSGD(50, pc.InverseStep(10, 801), gradient=pc.Exact()), [[[10.0]]]).history
    steps = [10 / (n + 801) for n in range(50)]
    expected = squared_errors(steps, 10.0, MEAN, sensitivity, 0.0)
    assert_close((history[:, 0, 0, 0] - stable_decision(MEAN, sensitivity)) ** 2, expected, 1e-12)


@pytest.fixture(scope="module")
def greedy_errors():
    """Squared errors of greedy steps with the published schedule, as a function of key and deviation."""
    stable = stable_decision(MEAN, 0.9)

    def errors(key, deviation, steps):
        solver = pc.RSGD(steps, pc.InverseStep(10, 801))
        problem = performative_prediction(0.9, deviation=deviation)
        record = lambda M: jnp.sum((M - stable) ** 2)  # noqa: E731
        return pc.solve(problem, solver, [[[10.0]]], key=key, record=record, every=100).history

    return jax.jit(jax.vmap(errors, in_axes=(0, None, None)), static_argnums=2)


def test_greedy_error_within_five_standard_errors_of_the_published_numbers(greedy_errors):
    errors = np.asarray(greedy_errors(jax.random.split(KEY, 64), 0.1, 10_000))
    expected = squared_errors([published_step_size(t, 0.9) for t in range(1, 10_001)], 10.0, MEAN, 0.9, 0.1)
    published = {100: 6400.00012, 1000: 1600.00031, 10_000: 44.44453}
    for t, number in published.items():
        assert abs(expected[t] - number) < 5e-5 * number
        assert_mean_is(errors[:, t // 100], expected[t])
        # the noise is small beside the error, so that the mean is sharp: the schedule and its offset are seen
        assert errors[:, t // 100].std() / 8 < 2e-3 * number


def test_greedy_error_within_five_standard_errors_of_the_recursion_when_noise_dominates(greedy_errors):
    errors = np.asarray(greedy_errors(jax.random.split(KEY, 64), 100.0, 10_000))
    expected = squared_errors([published_step_size(t, 0.9) for t in range(1, 10_001)], 10.0, MEAN, 0.9, 100.0)
    for t in (100, 1000, 5000, 10_000):
        assert_mean_is(errors[:, t // 100], expected[t])
    noiseless = squared_errors([published_step_size(t, 0.9) for t in range(1, 10_001)], 10.0, MEAN, 0.9, 0.0)
    assert expected[10_000] > 2 * noiseless[10_000]


# --- convergence -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stable():
    """The stable policy of `drifting(0)`."""
    return pc.solve(drifting(0), pc.RRM(max_steps=40)).M


def test_rsgd_mean_field_converges_to_the_stable_point(stable):
    solution = pc.solve(drifting(0), pc.RSGD(1200, 0.006, gradient=pc.Exact()), every=600)  # no key is needed
    assert_close(solution.M, stable, 1e-6)


def test_rsgd_error_falls_like_one_over_n_when_the_step_diminishes(stable):
    problem = drifting(0)
    solver = pc.RSGD(3200, pc.InverseStep(1.0, 200))

    def errors(key):
        return pc.solve(problem, solver, key=key, record=lambda M: jnp.sum((M - stable) ** 2), every=200).history

    mean = np.asarray(jax.jit(jax.vmap(errors))(jax.random.split(KEY, 48))).mean(axis=0)
    assert mean[-1] < 0.1 * mean[0]
    slope = np.polyfit(np.log(200 * np.arange(2, 17) + 200), np.log(mean[2:]), 1)[0]
    assert -1.6 < slope < -0.7, f"error falls like n^{slope:.2f}"


# --- failures --------------------------------------------------------------------------------------------------------


@pytest.mark.float32
def test_rsgd_ends_as_diverged_with_the_last_good_iterate_when_the_step_is_too_large():
    problem = performative_prediction(0.5)
    solver = pc.RSGD(700, 8.0, gradient=pc.Exact())  # the error is multiplied by 1 - 8 (1 - 0.5) = -3
    solution = pc.solve(problem, solver, throw=False)
    errors = 20.0 * 3.0 ** np.arange(40)
    expected = int(np.argmax(np.abs(20 - errors * (-1.0) ** np.arange(40)) > 1e8))
    assert solution.result == pc.Result.diverged
    assert int(solution.steps) == expected
    assert 1e7 < abs(float(solution.M[0, 0, 0])) < 1e8
    assert bool(jnp.all(jnp.isfinite(solution.history))) and solution.history.shape == (701, 1, 1, 1)
    np.testing.assert_array_equal(solution.history[expected - 1], solution.M)
    with pytest.raises(pc.SolveError, match=f"diminishing step.*step {expected}"):
        pc.solve(problem, solver)


@pytest.mark.float32
def test_rsgd_keeps_the_last_finite_iterate_when_a_step_is_not_finite():
    problem = performative_prediction(0.5)

    def burst(n):
        return jnp.where(n == 5, jnp.inf, 0.1)

    solution = pc.solve(problem, pc.RSGD(20, burst), key=KEY, throw=False)
    until_then = pc.solve(problem, pc.RSGD(5, 0.1), key=KEY)
    assert solution.result == pc.Result.nonfinite and int(solution.steps) == 6
    assert_close(solution.M, until_then.M, 1e-12, 1e-5)
    assert bool(jnp.all(jnp.isfinite(solution.history)))
    with pytest.raises(pc.SolveError, match=r"not finite.*step 6"):
        pc.solve(problem, pc.RSGD(20, burst), key=KEY)


def test_rsgd_tells_diverged_from_finished_runs_when_mapped_over_steps():
    problem = performative_prediction(0.5)

    def run(size):
        return pc.solve(problem, pc.RSGD(60, size, gradient=pc.Exact()))

    together = jax.vmap(run)(jnp.asarray([0.5, 8.0]))
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], together.result) for i in range(2)]
    assert each[0] == pc.Result.success and each[1] == pc.Result.diverged
    assert bool(jnp.all(jnp.isfinite(together.M)))


def test_rsgd_stays_bounded_on_a_bounded_set_when_the_step_is_too_large():
    problem = performative_prediction(0.5, feasible_set=pc.FrobeniusBall(30.0))
    solution = pc.solve(problem, pc.RSGD(100, 8.0, gradient=pc.Exact()))
    assert solution.result == pc.Result.success and float(jnp.max(jnp.abs(solution.history))) <= 30.0 + 1e-12
