"""RRM with a few gradient steps for each deployment: its definition, its rate, both ends of k, sampled costs."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.response.sampled import Sampled, approach
from tests.contracts.solver import SolverContract
from tests.solvers.problems import drifting, overflowing, performative_prediction, steered, strongly_performative
from tests.solvers.test_sampled_run import as_function, within
from tests.tools import assert_close, assert_refused


class TestInexactRRM(SolverContract):
    def solver(self):
        return pc.RRM(1e-4, 60, inner_steps=20)


class TestRepeatedGradientDescent(SolverContract):
    result_when_stopped = pc.Result.success

    def solver(self):
        return pc.RSGD(20, 0.01, gradient=pc.Exact())


def derivatives(problem, M):
    """𝐇 and 𝐄 at M, by central differences of the gradient."""
    M = np.asarray(M)
    units = 1e-5 * np.eye(M.size).reshape(-1, *M.shape)

    def columns(gradient):
        return np.stack([np.ravel(gradient(unit) - gradient(-unit)) / 2e-5 for unit in units], axis=1)

    H = columns(lambda change: pc.expected_gradient(problem, M + change, deployed=M))
    return H, columns(lambda change: pc.expected_gradient(problem, M, deployed=M + change))


def test_iterates_are_so_many_gradient_steps_of_length_one_over_the_hessian():
    problem = drifting(10, mean=0.0)
    history = pc.solve(problem, pc.RRM(inner_steps=3), max_steps=2, throw=False).history
    M = problem.initial_policy()
    for following in history[1:]:
        deployed, step = M, 1 / np.linalg.norm(derivatives(problem, M)[0], 2)
        for _ in range(3):
            M = M - step * pc.expected_gradient(problem, M, deployed=deployed)
        assert_close(following, M, 1e-7)


@pytest.mark.parametrize("steps", [1, 3])
def test_error_shrinks_at_the_rate_of_the_linear_map(steps):
    problem = steered()
    stable = pc.solve(problem, pc.StablePoint()).M
    H, E = derivatives(problem, stable)
    response = -np.linalg.solve(H, E)
    left = np.linalg.matrix_power(np.eye(2) - H / np.linalg.norm(H, 2), steps)
    rate = np.abs(np.linalg.eigvals(response + left @ (np.eye(2) - response))).max()
    solution = pc.solve(problem, pc.RRM(inner_steps=steps))
    assert_close(solution.M, stable, 1e-9)
    assert float(solution.stats["rate"]) == pytest.approx(rate, rel=1e-3)
    assert "unique" not in solution.stats


@pytest.mark.parametrize("feasible_set", [pc.FrobeniusBall(0.3), pc.Box(-0.1, 0.1), pc.RowSum(0.2)])
def test_policies_are_feasible_and_end_at_the_stable_policy_of_the_set(feasible_set):
    problem = drifting(0, feasible_set)
    solution = pc.solve(problem, pc.RRM(inner_steps=10, anderson=3))
    assert all(bool(feasible_set.contains(M, 1e-9)) for M in solution.history)
    assert_close(solution.M, pc.solve(problem, pc.StablePoint()).M, 1e-8)


def test_many_inner_steps_are_repeated_minimisation():
    problem = drifting(0, pc.FrobeniusBall(0.3))
    assert_close(pc.solve(problem, pc.RRM(inner_steps=400)).history, pc.solve(problem, pc.RRM()).history, 1e-9)


def test_few_inner_steps_settle_where_repeated_minimisation_cycles():
    problem = strongly_performative()
    assert pc.solve(problem, pc.RRM(max_steps=100), throw=False).result == pc.Result.not_converged
    solution = pc.solve(problem, pc.RRM(1e-7, inner_steps=5))
    assert_close(solution.M, pc.solve(problem, pc.StablePoint()).M, 1e-5)


def test_iterates_without_a_held_hessian_are_the_same_up_to_the_length_of_the_step(monkeypatch):
    problem = steered()
    held = pc.solve(problem, pc.RRM(inner_steps=5))
    monkeypatch.setattr(importlib.import_module("perfcontrol.response.quadratic"), "DENSE_LIMIT", 1)
    assert_close(pc.solve(problem, pc.RRM(inner_steps=5)).M, held.M, 1e-9)


# --- sampled costs ---------------------------------------------------------------------------------------------------


def test_sampled_steps_are_gradient_steps_on_the_mean_cost_of_the_same_paths():
    problem, key = as_function(steered(), lambda t, x, u: x @ x + 0.2 * u @ u), jax.random.key(3)
    deployed = np.array([[[0.2, -0.1]]])

    def mean_cost(M):
        return jnp.mean(pc.simulate(problem, M, deployed=deployed, key=key, samples=40).cost)

    H = jax.hessian(mean_cost)(jnp.zeros((1, 1, 2))).reshape(2, 2)
    M = jnp.asarray(deployed)
    for _ in range(3):
        M = M - jax.grad(mean_cost)(M) / np.linalg.norm(H, 2)
    found = approach(Sampled(problem, key, np.asarray(40)), deployed, deployed, 3)
    assert_close(found, M, 1e-9)


def test_sampled_steps_are_halved_until_the_cost_falls():
    flat = pc.LogCosh(0.1, np.ones(2), 0.2 * np.ones(1))  # far out nearly linear: 1/‖Hessian‖ leaps over the minimum
    problem, key = as_function(steered(), flat), jax.random.key(3)
    world, deployed = Sampled(problem, key, np.asarray(40)), np.zeros((1, 1, 2))
    costs, M = [], np.array([[[50.0, -80.0]]])
    for _ in range(6):
        costs.append(float(jnp.mean(pc.simulate(problem, M, deployed=deployed, key=key, samples=40).cost)))
        M = approach(world, deployed, M, 1)
    assert all(np.diff(costs) < 0) and costs[-1] < 0.5 * costs[0]


def test_sampled_run_ends_at_the_exact_stable_policy_within_its_error():
    problem = drifting(0, pc.FrobeniusBall(0.3))
    exact = pc.solve(problem, pc.StablePoint()).M
    assert within(pc.solve(as_function(problem), pc.RRM(0.1, inner_steps=4), key=jax.random.key(2)), exact)


def test_world_that_overflows_ends_as_nonfinite():
    problem = overflowing()
    for solver in (pc.RRM(inner_steps=3), pc.RRM(inner_steps=3, anderson=2)):
        solution = pc.solve(problem, solver, throw=False)
        assert solution.result == pc.Result.nonfinite and bool(jnp.all(jnp.isfinite(solution.history)))


def test_settings_that_make_no_sense_are_refused():
    assert_refused(lambda: pc.RRM(inner_steps=0), "inner_steps", "at least 1")
    assert_refused(lambda: pc.RRM(inner_steps=2.5), "inner_steps", "integer")
    assert_refused(lambda: pc.RRM(anderson=-1), "anderson", "at least 0")
    assert_refused(lambda: pc.RRM(anderson=True), "anderson", "integer")
    assert_refused(lambda: pc.solve(performative_prediction(0.5), pc.RRM(1e-30, inner_steps=2)), "tolerance", "reach")
