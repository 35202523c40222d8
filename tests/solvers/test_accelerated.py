"""RRM with Anderson's acceleration: against its definition in NumPy, exact ends where Φ is affine, ends where RRM has
none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.solver import SolverContract
from tests.evaluate.cases import replaced
from tests.oracles.performative_prediction import stable_decision
from tests.solvers.problems import MEAN, drifting, performative_prediction, steered, strongly_performative, swapped
from tests.solvers.test_sampled_run import as_function, within
from tests.tools import assert_close, tolerance


class TestAcceleratedRRM(SolverContract):
    close = (1e-9, 1e-3)  # small linear systems of nearly parallel differences

    def solver(self):
        return pc.RRM(max_steps=20, anderson=3)


def by_hand(problem, steps, memory):
    """Anderson (1965): weights of sum one over the last images, of least combined gap."""
    policies, images = [np.asarray(problem.initial_policy())], []
    for _ in range(steps):
        images.append(np.asarray(pc.best_response(problem, policies[-1])))
        recent = slice(-min(memory + 1, len(images)), None)
        gaps = np.stack([(i - p).ravel() for i, p in zip(images, policies, strict=True)][recent])
        ones = np.ones(len(gaps))
        weights = np.linalg.pinv(gaps @ gaps.T) @ ones
        mixed = np.tensordot(weights / weights.sum(), np.stack(images[recent]), axes=1)
        policies.append(np.asarray(problem.feasible_set.project(jnp.asarray(mixed))))
    return np.stack(policies)


@pytest.mark.parametrize("feasible_set", [None, pc.FrobeniusBall(2.45)])
@pytest.mark.parametrize("memory", [1, 2])
def test_iterates_are_affine_combinations_of_images_with_the_least_combined_gap(memory, feasible_set):
    problem = replaced(strongly_performative(), **({"feasible_set": feasible_set} if feasible_set else {}))
    history = pc.solve(problem, pc.RRM(max_steps=4, anderson=memory), throw=False).history
    assert_close(history, by_hand(problem, 4, memory), 1e-7)
    assert not np.allclose(history[2], pc.best_response(problem, history[1]), rtol=0.01)


@pytest.mark.parametrize("sensitivity", [0.9, 1.5, -3.0])
@pytest.mark.float32
def test_an_affine_reaction_of_one_eigenvalue_ends_at_the_third_deployment_whatever_its_size(sensitivity):
    solution = pc.solve(performative_prediction(sensitivity), pc.RRM(anderson=1))
    assert int(solution.steps) == 3
    assert_close(solution.M, np.full((1, 1, 1), stable_decision(MEAN, sensitivity)), 1e-11, 1e-4)


def test_an_affine_reaction_of_two_eigenvalues_ends_at_the_fourth_deployment():
    problem = swapped(3.0, 0.5)  # eigenvalues ±√1.5
    start = jnp.asarray([[[2.0, 0.0], [-1.0, 0.0]]])
    assert pc.solve(problem, pc.RRM(), start, throw=False).result == pc.Result.diverged
    history = pc.solve(problem, pc.RRM(anderson=2), start).history
    assert float(jnp.linalg.norm(history[2])) > 0.1 and float(jnp.linalg.norm(history[3])) < 1e-12


def test_fewer_deployments_where_rrm_contracts_and_an_end_where_it_cycles():
    problem = steered()
    stable = pc.solve(problem, pc.StablePoint()).M
    plain, mixed = pc.solve(problem, pc.RRM()), pc.solve(problem, pc.RRM(anderson=3))
    assert_close(mixed.M, stable, 1e-10)
    assert 2 * int(mixed.steps) <= int(plain.steps)
    cycling = strongly_performative()
    solution = pc.solve(cycling, pc.RRM(anderson=3))
    assert int(solution.steps) <= 20
    assert_close(solution.M, pc.solve(cycling, pc.StablePoint()).M, 1e-9)


def test_every_deployed_policy_is_feasible_though_combinations_may_leave_the_set():
    feasible_set = pc.FrobeniusBall(2.45)
    problem = replaced(strongly_performative(), feasible_set=feasible_set)
    solution = pc.solve(problem, pc.RRM(anderson=3))
    assert all(bool(feasible_set.contains(M, 1e-9)) for M in solution.history)
    assert_close(solution.M, pc.solve(problem, pc.StablePoint()).M, 1e-9)


def test_start_at_the_stable_policy_ends_at_once():
    problem = drifting(0)
    stable = pc.solve(problem, pc.RRM()).M
    solution = pc.solve(problem, pc.RRM(1e-10, anderson=5), stable)
    assert int(solution.steps) == 1 and bool(jnp.all(jnp.isfinite(solution.M)))


def test_sampled_responses_are_accelerated_too():
    problem = steered()
    exact = pc.solve(problem, pc.StablePoint()).M
    convex = as_function(problem, lambda t, x, u: x @ x + 0.2 * u @ u)
    solution = pc.solve(convex, pc.RRM(0.05, anderson=2), key=jax.random.key(2))
    assert within(solution, exact)
    assert float(jnp.linalg.norm(solution.stats["standard_error"])) <= 0.05 * float(jnp.linalg.norm(solution.M))


@pytest.mark.float32
def test_gaps_below_rounding_do_no_harm():
    problem = drifting(0)
    least = tolerance(1e-14, 2.5e-6)  # the smallest that are accepted
    solution = pc.solve(problem, pc.RRM(least, max_steps=30, anderson=5), throw=False)
    assert bool(jnp.all(jnp.isfinite(solution.history)))
    assert_close(solution.M, pc.solve(problem, pc.RRM()).M, 1e-10, 1e-4)
