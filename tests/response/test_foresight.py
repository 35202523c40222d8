"""Sampled costs of policies in their own worlds, and the optimum found by them, against the exact engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.response import foresight
from perfcontrol.response.foresight import Foreseen
from tests.tools import assert_refused

N = 4096
KEY = jax.random.key(5)


def _law(kind: str):
    if kind == "directional":
        return pc.DirectionalPerturbation(np.array([[[0.6, 0.1], [0.0, 0.5]]]), pc.Norm([0.3], [0.6], squared=True))

    def probabilities(M):
        weights = jnp.exp(jnp.stack([M[0, 0, 0], -M[0, 0, 0], 0.5 * M[0, 0, 1]]))
        return weights / jnp.sum(weights)

    atoms = np.array([[[0.5, 0.1], [0.0, 0.3]], [[-0.6, 0.0], [0.2, 0.1]], [[0.1, 0.2], [0.1, -0.4]]])
    return pc.FinitePerturbation(atoms, probabilities)


def problem_of(kind: str, convex: bool = False, feasible_set=None) -> pc.PerformativeProblem:
    Q, R = np.diag([1.0, 2.0]), np.array([[0.3]])
    quadratic = pc.QuadraticCost(Q, R)

    def stage(t, x, u):
        return x @ Q @ x + u @ R @ u

    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.7, 0.2], [0.0, 0.6]], [[1.0], [0.4]]), horizon=6, memory=1, gain=np.zeros((1, 2)),
        noise=pc.Uniform([-0.8, -0.5], [1.0, 1.2]), cost=pc.ConvexCost(stage) if convex else quadratic,
        perturbation=_law(kind), feasible_set=feasible_set or pc.Unconstrained(),
    )  # fmt: skip


def world_of(kind: str, reference, samples: int = N) -> Foreseen:
    return Foreseen(problem_of(kind, convex=True), KEY, np.asarray(samples), np.asarray(reference))


@pytest.mark.parametrize("kind", ["directional", "finite"])
def test_sampled_total_gradient_is_within_five_standard_errors_of_the_exact_one(kind):
    M = np.array([[[-0.4, -0.2]]])
    world, exact = world_of(kind, M), problem_of(kind)
    value, gradient = foresight.value_and_gradient(world, M)
    _, covariance = foresight.curvature(world, M)
    errors = np.sqrt(np.diag(covariance) / N)
    apart = np.abs(np.asarray(gradient - pc.expected_gradient(exact, M, total=True))).reshape(-1)
    assert np.all(apart < 5 * errors) and np.all(errors < 0.1 * np.linalg.norm(gradient))
    paths = pc.estimate_cost(exact, M, key=KEY, samples=N)
    assert float(value) == pytest.approx(float(paths.mean), rel=1e-10)  # the same paths


@pytest.mark.parametrize("kind", ["directional", "finite"])
def test_value_gradient_and_hessian_of_the_sample_agree_with_central_differences(kind):
    reference, M = np.array([[[-0.4, -0.2]]]), np.array([[[-0.3, -0.1]]])
    world, step = world_of(kind, reference, 200), 1e-5
    ways = step * np.eye(2).reshape(2, 1, 1, 2)
    ahead, behind = (foresight.values_and_gradients(world, M + sign * ways) for sign in (1, -1))
    _, gradient = foresight.value_and_gradient(world, M)
    hessian, _ = foresight.curvature(world, M)
    np.testing.assert_allclose(((ahead[0] - behind[0]) / (2 * step)), np.ravel(gradient), rtol=1e-7)
    by_differences = np.asarray((ahead[1] - behind[1]) / (2 * step)).reshape(2, 2)
    np.testing.assert_allclose(hessian, by_differences, rtol=1e-6, atol=1e-7 * np.abs(hessian).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "feasible_set"),
    [
        ("directional", pc.Unconstrained()),
        ("finite", pc.Box(-0.25, 0.1)),
        pytest.param("finite", pc.Unconstrained(), marks=pytest.mark.slow),
        pytest.param("directional", pc.Box(-0.25, 0.1), marks=pytest.mark.slow),
    ],
)
def test_sampled_optimum_is_as_far_from_the_exact_one_as_it_says(kind, feasible_set):
    exact = pc.solve(problem_of(kind, feasible_set=feasible_set), pc.PerformativeOptimum())
    solver = pc.PerformativeOptimum(tolerance=0.03, sampling=pc.SampleAverage(512))
    found = pc.solve(problem_of(kind, True, feasible_set), solver, key=KEY)
    distance = float(jnp.linalg.norm(found.M - exact.M))
    assert distance <= 2 * float(found.stats["confidence_radius"]) + 1e-9
    assert float(jnp.linalg.norm(found.stats["standard_error"])) <= 0.03 * float(jnp.linalg.norm(found.M))
    cost = pc.expected_cost(problem_of(kind), found.M)
    stable = pc.expected_cost(
        problem_of(kind), pc.solve(problem_of(kind, feasible_set=feasible_set), pc.StablePoint()).M
    )
    assert float(exact.stats["cost"]) <= float(cost) * (1 + 1e-9) < float(stable) * (1 + 1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["directional", "finite"])
def test_ball_of_confidence_holds_the_optimum_as_often_as_it_says(kind):
    exact = pc.solve(problem_of(kind), pc.PerformativeOptimum()).M
    solver, inside = pc.PerformativeOptimum(tolerance=0.05, sampling=pc.SampleAverage(1024)), 0
    problem = problem_of(kind, True)  # once: its function is a new one each time, and compiled anew
    for seed in range(40):
        found = pc.solve(problem, solver, key=jax.random.key(seed))
        inside += float(jnp.linalg.norm(found.M - exact)) <= float(found.stats["confidence_radius"])
    print(f"{kind}: {inside} of 40")
    assert inside >= 34  # of 95 %, fewer in one case of two hundred


def test_optimum_without_moments_asks_for_a_key():
    with pytest.raises(pc.InputError, match="key"):
        pc.solve(problem_of("directional", convex=True), pc.PerformativeOptimum())
    assert_refused(lambda: pc.PerformativeOptimum(sampling=5), "sampling", "pc.SampleAverage()")


def test_laws_whose_draws_move_are_not_weighed():
    assert not world_of("directional", np.zeros((1, 1, 2))).weighed and world_of("finite", np.zeros((1, 1, 2))).weighed
