"""Repeated risk minimisation: its iterates, its rate, and how it ends where it does not contract."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.solver import SolverContract
from tests.oracles.performative_prediction import stable_decision
from tests.solvers.problems import MEAN, drifting, overflowing, performative_prediction, strongly_performative
from tests.tools import assert_close, assert_refused, tolerance


class TestRRM(SolverContract):
    def solver(self):
        return pc.RRM(max_steps=40)


def test_rrm_iterates_are_best_responses_to_their_predecessors():
    problem = drifting(0)
    history = pc.solve(problem, pc.RRM(max_steps=40)).history
    for n in range(3):
        assert_close(history[n + 1], pc.best_response(problem, history[n]), 1e-11)


@pytest.mark.parametrize("sensitivity", [0.9, 0.5, -0.9])
def test_rrm_contracts_at_exactly_the_published_sensitivity(sensitivity):
    problem = performative_prediction(sensitivity)
    solution = pc.solve(problem, pc.RRM())
    stable = stable_decision(MEAN, sensitivity)
    assert_close(solution.M, np.full((1, 1, 1), stable), 1e-9)
    errors = solution.history[:20, 0, 0, 0] - stable
    assert_close(errors[1:] / errors[:-1], np.full(19, sensitivity), 1e-10)
    assert abs(float(solution.stats["rate"]) - abs(sensitivity)) < 1e-3


@pytest.mark.parametrize("sensitivity", [1.5, -3.0])
@pytest.mark.float32
def test_rrm_ends_as_diverged_when_the_published_sensitivity_exceeds_one(sensitivity):
    problem = performative_prediction(sensitivity)
    solution = pc.solve(problem, pc.RRM(), throw=False)
    assert solution.result == pc.Result.diverged
    stable = stable_decision(MEAN, sensitivity)
    policies = stable * (1 - sensitivity ** np.arange(60.0))
    assert int(solution.steps) == int(np.argmax(np.abs(policies) > 1e8))
    assert_close(solution.M[0, 0, 0], policies[int(solution.steps) - 1], 1e-11, 1e-3)
    with pytest.raises(pc.SolveError, match=r"pc\.StablePoint"):
        pc.solve(problem, pc.RRM())


def test_rrm_ends_as_not_converged_when_it_drifts_without_a_fixed_point():
    solution = pc.solve(performative_prediction(1.0), pc.RRM(max_steps=30), throw=False)
    assert solution.result == pc.Result.not_converged and int(solution.steps) == 30
    assert_close(solution.history[:, 0, 0, 0], MEAN * np.arange(31), 1e-12)


def test_rrm_ends_as_not_converged_when_it_cycles():
    solution = pc.solve(strongly_performative(), pc.RRM(max_steps=40), throw=False)
    assert solution.result == pc.Result.not_converged
    assert float(jnp.linalg.norm(solution.M - solution.history[-2])) > 0.1 * float(jnp.linalg.norm(solution.M))


def test_rrm_ends_as_nonfinite_with_the_last_finite_iterate_when_the_world_overflows():
    problem = overflowing()
    solution = pc.solve(problem, pc.RRM(), throw=False)
    assert solution.result == pc.Result.nonfinite and int(solution.steps) == 2
    np.testing.assert_array_equal(solution.M, solution.history[1])
    assert bool(jnp.all(jnp.isfinite(solution.history)))


def test_rrm_stops_at_the_tolerance_asked_for():
    loose = pc.solve(performative_prediction(0.5), pc.RRM(tolerance=1e-3))
    policies = 20 * (1 - 0.5 ** np.arange(1, 40.0))  # of steps 1, 2, ...
    moves = np.diff(policies, prepend=0.0)
    assert int(loose.steps) == 1 + int(np.argmax(moves <= 1e-3 * policies))


@pytest.mark.float32
@pytest.mark.parametrize("solver", [pc.RRM, pc.StablePoint])
def test_tolerance_is_refused_when_out_of_reach(solver):
    problem = performative_prediction(0.5)
    assert_refused(
        lambda: pc.solve(problem, solver(tolerance=tolerance(1e-16, 1e-9))), "tolerance", "what float", "can reach"
    )
    assert_refused(lambda: pc.solve(problem, solver(tolerance=-1.0)), "tolerance", "positive")
    assert_refused(lambda: pc.solve(problem, solver(tolerance=float("nan"))), "tolerance", "positive")
    assert_refused(lambda: pc.solve(problem, solver(tolerance="tight")), "tolerance", "positive")
    assert_refused(lambda: solver(max_steps=0), "max_steps", "at least 1")


def test_tolerance_of_double_precision_is_refused_when_the_problem_is_single():
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), performative_prediction(0.5))
    for solver in (pc.RRM(1e-9), pc.StablePoint(1e-9)):
        assert_refused(lambda solver=solver: pc.solve(single, solver), "tolerance", "float32", "jax_enable_x64")
