"""The controller: the iterates of `pc.solve`, the noise that is recovered, what it refuses."""

import equinox as eqx
import jax
import numpy as np
import optax
import pytest

import perfcontrol as pc
from tests.online.plants import drawn, run_episode, system_at
from tests.solvers.problems import drifting
from tests.tools import normal, relative_error, tolerance

key = jax.random.key(3)


def episodes_of(problem, solver, state, n):
    """The draws that `pc.solve` uses at its step n."""
    step_key = jax.random.fold_in(key, n)
    keys = [step_key] if solver.batch == 1 else [jax.random.fold_in(step_key, i) for i in range(solver.batch)]
    finite = problem if problem.is_finite else problem.truncated(solver.truncation)
    return [drawn(finite, state.deployed, k) for k in keys]


def learn(problem, solver, steps, observed=True):
    controller = pc.online.Controller(problem, solver, gate=False)
    state = controller.init()
    for n in range(steps):
        for draws in episodes_of(problem, solver, state, n):
            state = run_episode(controller, state, problem, draws, observed)
    return state


def varying() -> pc.PerformativeProblem:
    """Matrices that vary in time, perturbations that act on state and input, policies of few parameters."""
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.3 * normal(1, 4, 2, 2), normal(2, 4, 2, 2)),
        horizon=4,
        noise=pc.Gaussian([0.3, -0.2], np.eye(2)),
        cost=pc.QuadraticCost(np.eye(2), np.eye(2), state_target=[0.5, 0.0]),
        memory=2,
        gain=0.1 * normal(3, 5, 2, 2),
        perturbation=pc.DirectionalPerturbation(
            normal(4, 1, 2, 4),
            pc.Norm([0.2], [0.3]),
            mean=pc.Affine(0.1 * normal(5, 2, 4), 0.1 * normal(6, 2, 4, 2, 2, 2)),
        ),
        structure=pc.RepeatedBlock(2),
        initial_state=pc.Uniform(-np.ones(2), np.ones(2)),
    )


def endless() -> pc.PerformativeProblem:
    """A scalar plant in the long run."""
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5]], [[1.0]]),
        horizon=np.inf,
        noise=pc.Gaussian([0.0], [[1.0]]),
        cost=pc.QuadraticCost([[1.0]], [[0.1]]),
        perturbation=pc.DirectionalPerturbation([[[1.0]]], pc.Norm([0.1], [0.2])),
    )


CASES = {
    "greedy": (drifting, {}),
    "batch": (drifting, {"batch": 3}),
    "lazy": (drifting, {"schedule": pc.Lazy(2)}),
    "diminishing": (drifting, {"step_size": pc.InverseStep(1.0, 50.0)}),
    "averaged": (drifting, {"average": pc.Average(0.0, "batch means"), "steps": 100}),
    "transformed": (drifting, {"transform": optax.scale_by_adam()}),
    "in a ball": (lambda: drifting(feasible_set=pc.FrobeniusBall(0.2)), {"step_size": 0.1}),
    "varying": (varying, {}),
    "endless": (endless, {"truncation": 9, "step_size": 0.2}),
}


@pytest.mark.float32
@pytest.mark.parametrize("case", CASES)
def test_iterates_are_those_of_solve_from_the_same_draws(case):
    build, settings = CASES[case]
    problem = build()
    solver = pc.RSGD(**({"steps": 5, "step_size": 0.02} | settings))
    state = learn(problem, solver, 5)
    solution = pc.solve(problem, solver, key=key, max_steps=5)
    assert relative_error(state.learner.M, solution.M) < tolerance(1e-12, 1e-4)
    assert np.linalg.norm(solution.M) > 0.03


def test_noise_is_recovered_whatever_the_plant_was_given_and_inputs_are_those_of_the_law():
    problem = varying()
    M = 0.3 * np.asarray(normal(7, *problem.policy_shape))
    controller = pc.online.Controller(problem, pc.RSGD(3, 0.01), gate=False)
    state = controller.init(M)
    x, w, deltas = drawn(problem, M, key)
    lifted, gains = np.asarray(problem.lift(M)), np.asarray(problem.gain)
    states, inputs, matrices = [x], [], []
    for t in range(4):
        asked = controller.act(state, x)
        law = -gains[t] @ x + sum(lifted[i - 1] @ w[t - i] for i in (1, 2) if t >= i)
        np.testing.assert_allclose(asked, law, rtol=1e-12, atol=1e-12)
        u = np.clip(asked, -0.1, 0.1)
        A = np.concatenate(system_at(problem, t), axis=1) + deltas[t]
        following = A @ np.concatenate([x, u]) + w[t]
        state = controller.observe(state, x, u, following, A)
        x = following
        states, inputs, matrices = [*states, x], [*inputs, u], [*matrices, A]
    np.testing.assert_allclose(state.progress.episodes.w[0], w, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(state.progress.episodes.matrices[0], deltas, rtol=1e-12, atol=1e-13)


def test_recovered_noise_is_that_of_recover_noise():
    problem = drifting()
    controller = pc.online.Controller(problem, pc.RSGD(3, 0.01), gate=False)
    state, T = controller.init(), problem.horizon
    rng = np.random.default_rng(0)
    x, u, A = rng.normal(size=(T + 1, 3)), rng.normal(size=(T + 1, 2)), rng.normal(size=(T, 3, 3))
    for t in range(T):
        state = controller.observe(state, x[t], u[t], x[t + 1], A[t])
    np.testing.assert_allclose(
        state.progress.episodes.w[0],
        pc.recover_noise(problem, *map(jax.numpy.asarray, (x, u, A))),
        rtol=1e-12,
        atol=1e-12,
    )


def test_without_observed_matrices_it_learns_the_same_where_perturbations_do_not_scatter():
    calm = varying()
    mean = calm.perturbation.mean(calm.lift(calm.initial_policy()), 1)
    assert np.abs(np.asarray(mean)).max() > 0.05
    problem = eqx.tree_at(lambda p: p.perturbation.scale, calm, pc.Norm([0.0], [0.0]))
    solver = pc.RSGD(4, 0.02)
    state = learn(problem, solver, 4, observed=False)
    assert relative_error(state.learner.M, pc.solve(problem, solver, key=key).M) < 1e-12


def test_without_observed_matrices_what_scatters_counts_as_noise():
    problem = drifting()
    controller = pc.online.Controller(problem, pc.RSGD(3, 0.01), gate=False)
    state = controller.init()
    x, w, deltas = drawn(problem, state.deployed, key)
    u, (A, B) = controller.act(state, x), system_at(problem, 0)
    state = controller.observe(state, x, u, (A + deltas[0]) @ x + B @ u + w[0])
    np.testing.assert_allclose(state.progress.episodes.w[0, 0], w[0] + deltas[0] @ x, rtol=1e-12)


def test_methods_are_pure_an_episode_can_be_left_out_and_its_cost_is_in_the_log():
    problem = drifting()
    controller = pc.online.Controller(problem, pc.RSGD(2, 0.02), gate=False)
    first = controller.init()
    draws = drawn(problem, first.deployed, jax.random.fold_in(key, 0))
    once, again = (run_episode(controller, first, problem, draws) for _ in range(2))
    for a, b in zip(jax.tree.leaves(once), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert once.log == again.log and int(first.episode) == 0 and first.log == ()
    cost = pc.simulate(problem, first.deployed, key=key).cost[0]
    np.testing.assert_allclose(once.log[0].cost, cost, rtol=1e-12)


def test_learning_ends_with_the_steps_of_the_solver():
    problem = drifting()
    state = learn(problem, pc.RSGD(2, 0.02), 3)
    assert [entry.deployed for entry in state.log] == [True, True, False]
    assert "all 2 steps" in state.log[-1].reason
    np.testing.assert_array_equal(state.deployed, state.learner.M)


def test_ungated_run_that_diverges_ends_as_that_of_solve():
    problem, solver = drifting(), pc.RSGD(6, 1e4)
    state = learn(problem, solver, 6)
    solution = pc.solve(problem, solver, key=key, throw=False)
    assert solution.result == pc.Result.diverged == state.learner.result
    assert relative_error(state.learner.M, solution.M) < 1e-9
    assert "learning has ended" in state.log[-1].reason and "divergence threshold" in state.log[-1].reason
