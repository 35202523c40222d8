"""Gradients that see less than the paper's: costs alone, or states, inputs and noise without the perturbations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.adjoint import mean_path_gradient
from tests.contracts.solver import SolverContract
from tests.solvers.problems import drifting, performative_prediction, steered
from tests.tools import assert_close, assert_mean_is, assert_refused, central_differences

KEY = jax.random.key(21)
M, DEPLOYED = jnp.asarray([[[0.3, -0.2]]]), jnp.asarray([[[-0.4, 0.1]]])  # of `steered`


class TestRSGDByTwoPoint(SolverContract):
    result_when_stopped = pc.Result.success
    close = (1e-9, 5e-3)  # differences of costs

    def solver(self):
        return pc.RSGD(12, 1e-4, gradient=pc.TwoPoint(0.5))


class TestRSGDByEstimatedDynamics(SolverContract):
    result_when_stopped = pc.Result.success
    close = (1e-9, 5e-3)  # a linear system per step

    def solver(self):
        return pc.RSGD(12, 1e-3, batch=8, gradient=pc.EstimatedDynamics())


def estimates(gradient, problem, batch, count):
    """Independent estimates at M in the world of DEPLOYED."""
    return jax.jit(jax.vmap(lambda key: gradient(problem, M, DEPLOYED, key, batch)))(jax.random.split(KEY, count))


# --- two points ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [1e-2, 3.0])
def test_two_point_mean_is_the_exact_gradient_of_a_quadratic_cost_at_any_radius(radius):
    problem = steered()
    expected = pc.expected_gradient(problem, M, deployed=DEPLOYED)
    samples = np.asarray(estimates(pc.TwoPoint(radius), problem, 2, 10_000))
    assert_mean_is(samples, expected)
    error = samples.std(axis=0) / 100
    assert np.all(error < 0.1 * np.linalg.norm(expected)), "too noisy to say anything"
    own = pc.expected_gradient(problem, M)  # in the world of M itself
    assert np.any(np.abs(samples.mean(axis=0) - own) > 5 * error), "the world must be that of the deployed policy"


def test_two_point_estimate_is_the_path_gradient_along_its_direction():
    problem = drifting(0)
    policy, size = 0.1 * jnp.ones(problem.policy_shape), 12
    estimate = np.ravel(pc.TwoPoint(2.0)(problem, policy, policy, KEY, 1))
    path_key, _ = jax.random.split(jax.random.fold_in(KEY, 0))
    gradient = np.ravel(mean_path_gradient(problem, policy, policy, path_key, 1))
    # estimate = p (g·U) U, so that |estimate|² = p g·estimate, whatever U is
    assert_close(estimate @ estimate, size * gradient @ estimate, 1e-9)


def test_two_point_estimate_is_the_slope_of_the_smoothed_cost():
    # one parameter: the derivative of the average over [M - r, M + r] is (C(M + r) - C(M - r)) / (2r)
    def stage(t, x, u):
        return jnp.sum(jnp.where(t == 2, x**4, 0.0 * x))

    world = performative_prediction(0.5, mean=1.0, deviation=0.3)
    problem = pc.PerformativeProblem(
        system=world.system, horizon=2, noise=world.noise, cost=pc.ConvexCost(stage), perturbation=world.perturbation
    )
    policy, other = jnp.full((1, 1, 1), 0.7), jnp.full((1, 1, 1), 0.2)
    gradients = jax.vmap(lambda key: pc.TwoPoint(0.8)(problem, policy, other, key, 1))(jax.random.split(KEY, 4000))
    z = 1.0 + 0.5 * 0.2 + 0.3 * np.array([-1.0, 1.0])
    cost = lambda theta: np.mean((z - theta) ** 4)  # noqa: E731
    assert_mean_is(gradients[:, 0, 0, 0], (cost(1.5) - cost(-0.1)) / 1.6)


def test_rsgd_by_two_points_comes_to_the_stable_point():
    problem = steered()
    stable = pc.solve(problem, pc.StablePoint()).M
    solver = pc.RSGD(4000, pc.PowerStep(0.03, 0.6), gradient=pc.TwoPoint(1.0), average=True)
    solution = pc.solve(problem, solver, key=KEY)
    assert pc.confidence_region(solution, 0.999).contains(stable)
    assert float(jnp.linalg.norm(solution.M - stable)) < 0.1


# --- estimated dynamics ----------------------------------------------------------------------------------------------


def quiet(scale=None, horizon=6):
    """`steered`, with a perturbation that may not scatter, and a noise with a mean."""
    problem = steered()
    perturbation = problem.perturbation
    return pc.PerformativeProblem(
        system=problem.system,
        horizon=horizon,
        noise=pc.Rademacher([1.0, 0.5], mean=[0.3, 0.0]),
        cost=problem.cost,
        gain=problem.gain,
        perturbation=pc.DirectionalPerturbation(
            perturbation.directions, jnp.zeros(1) if scale is None else scale, mean=perturbation.mean_map
        ),
        initial_state=[1.0, -1.0],
    )


def test_estimated_dynamics_gradient_matches_regression_and_differences_in_numpy():
    problem, batch = quiet(jnp.asarray([0.5])), 5
    gradient = pc.EstimatedDynamics(ridge=0.0)(problem, M, DEPLOYED, KEY, batch)
    paths = jax.tree.map(np.asarray, pc.simulate(problem, M, deployed=DEPLOYED, key=KEY, samples=batch))
    A, B, K = (np.asarray(a) for a in (problem.system.A, problem.system.B, problem.gain))
    moved = paths.x[:, 1:] - paths.x[:, :-1] @ A.T - paths.u[:, :-1] @ B.T - paths.w
    design = np.concatenate([paths.x[:, :-1], np.ones((batch, 6, 1))], axis=-1)
    slope = np.linalg.lstsq(design.reshape(-1, 3), moved.reshape(-1, 2), rcond=None)[0][:2].T

    def cost(policy):
        total = 0.0
        for x, u, noise in zip(paths.x, paths.u, paths.w, strict=True):
            away = np.zeros(2)  # from the path that was observed, under the estimated dynamics
            for t in range(7):
                change = (policy - np.asarray(M))[0] @ (noise[t - 1] if t > 0 else np.zeros(2))
                state, action = x[t] + away, u[t] + change - K @ away
                total += state @ state + 0.2 * action @ action
                away = (A + slope) @ away + B @ (action - u[t])
        return total / batch

    assert_close(gradient, central_differences(cost, np.asarray(M), 0.1), 1e-9)


def test_estimated_dynamics_gradient_is_that_of_the_paths_where_perturbations_do_not_scatter():
    problem = quiet()
    estimated = pc.EstimatedDynamics(ridge=0.0)(problem, M, DEPLOYED, KEY, 2)
    assert_close(estimated, pc.sample_gradient(problem, M, deployed=DEPLOYED, key=KEY, samples=2), 1e-9)


def test_estimated_dynamics_keeps_a_bias_where_the_perturbation_scatters():
    problem = quiet(jnp.asarray([2.0]))
    expected = pc.expected_gradient(problem, M, deployed=DEPLOYED)
    samples = np.asarray(estimates(pc.EstimatedDynamics(), problem, 256, 400))
    gap = np.abs(samples.mean(axis=0) - expected)
    assert np.any(gap > 5 * samples.std(axis=0) / 20) and np.linalg.norm(gap) > 0.1 * np.linalg.norm(expected)


def test_estimated_dynamics_is_finite_where_states_do_not_vary():
    gradient = pc.EstimatedDynamics()(performative_prediction(0.5), jnp.ones((1, 1, 1)), jnp.ones((1, 1, 1)), KEY, 1)
    assert bool(jnp.all(jnp.isfinite(gradient)))


def test_gradients_refuse_settings_that_make_no_sense():
    for radius in (0.0, -1.0, [1.0, 2.0], float("nan")):
        assert_refused(lambda radius=radius: pc.TwoPoint(radius), "radius", "")
    assert_refused(lambda: pc.EstimatedDynamics(-1e-3), "ridge", "not negative")
    assert_refused(lambda: pc.solve(steered(), pc.RSGD(3, 0.1, gradient=pc.TwoPoint(1.0))), "key", "jax.random.key(0)")
