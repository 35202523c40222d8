import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.cost import CostContract
from tests.tools import assert_close, assert_refused, normal, random_psd


class Soft(eqx.Module):
    """Log-cosh of the state, growing in time, and a smoothed absolute value of the input."""

    sharpness: jax.Array

    def __call__(self, t, x, u):
        return (1 + t) * jnp.sum(jnp.logaddexp(self.sharpness * x, -self.sharpness * x)) + jnp.sum(jnp.sqrt(1 + u**2))


class TestConvexCost(CostContract):
    difference_tolerance = 1e-6

    def cost(self):
        return pc.ConvexCost(Soft(jnp.asarray(1.5)))


class TestDiscountedConvexCost(CostContract):
    difference_tolerance = 1e-6

    def cost(self):
        return pc.ConvexCost(Soft(jnp.asarray(1.5)), discount=0.8)


Q, R = random_psd(1, 3), random_psd(2, 2)


def quadratic_stage(t, x, u):
    return x @ Q @ x + u @ R @ u


def growing(M):
    return 1 + jnp.sum(M**2)[None]


def test_convex_cost_is_its_function_at_every_stage():
    cost, x, u = Soft(jnp.asarray(1.5)), normal(8, 5, 3), normal(9, 5, 2)
    expected = [cost(t, x[t], u[t]) for t in range(5)]
    assert_close(pc.ConvexCost(cost).path_cost(x, u), expected)
    slopes = [jax.grad(cost, argnums=(1, 2))(t, x[t], u[t]) for t in range(5)]
    for i, values in enumerate(pc.ConvexCost(cost).path_gradients(x, u)):
        assert_close(values, [slope[i] for slope in slopes])


def problem(cost):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.4 * normal(1, 3, 3), normal(2, 3, 2)),
        horizon=4,
        memory=2,
        noise=pc.Rademacher(np.ones(3)),
        cost=cost,
        perturbation=pc.DirectionalPerturbation(0.3 * normal(3, 1, 3, 3), growing),
    )


@pytest.mark.float32
def test_convex_cost_written_as_a_quadratic_simulates_like_it():
    """The same numbers by automatic differentiation: costs, gradients and a run of RSGD."""
    one, two = problem(pc.QuadraticCost(Q, R)), problem(pc.ConvexCost(quadratic_stage))
    M, key = 0.3 * normal(4, 2, 2, 3), jax.random.key(5)
    first, second = pc.simulate(one, M, key=key, samples=4), pc.simulate(two, M, key=key, samples=4)
    assert_close(second.cost, first.cost, 1e-12, 1e-5)
    one_estimate, two_estimate = (pc.estimate_cost(p, M, key=key, samples=64) for p in (one, two))
    assert_close(two_estimate.mean, one_estimate.mean, 1e-12, 1e-5)
    assert_close(pc.sample_gradient(two, M, key=key), pc.sample_gradient(one, M, key=key), 1e-12, 1e-4)
    solver = pc.RSGD(20, 0.001)
    assert_close(pc.solve(two, solver, key=key).M, pc.solve(one, solver, key=key).M, 1e-11, 1e-3)


def test_sample_gradient_of_a_convex_cost_is_the_derivative_of_the_same_paths():
    convex, M, deployed = problem(pc.ConvexCost(Soft(jnp.asarray(2.0)))), 0.3 * normal(4, 2, 2, 3), normal(5, 2, 2, 3)
    key = jax.random.key(6)

    def mean_cost(M):
        return jnp.mean(pc.simulate(convex, M, deployed=deployed, key=key, samples=3).cost)

    assert_close(pc.sample_gradient(convex, M, deployed=deployed, key=key, samples=3), jax.grad(mean_cost)(M), 1e-11)


def test_rsgd_with_a_convex_cost_lowers_it_in_the_world_that_it_makes():
    convex, key = problem(pc.ConvexCost(Soft(jnp.asarray(2.0)))), jax.random.key(7)
    solution = pc.solve(convex, pc.RSGD(200, 0.005, batch=4), key=key)
    assert solution.result == pc.Result.success
    costs = [
        np.asarray(pc.simulate(convex, M, deployed=solution.M, key=key, samples=4096).cost)
        for M in (jnp.zeros((2, 2, 3)), solution.M)
    ]
    saved = costs[0] - costs[1]  # on the same paths
    assert saved.mean() > 5 * saved.std() / np.sqrt(4096)


def test_exact_functions_refuse_a_convex_cost():
    convex, M, key = problem(pc.ConvexCost(quadratic_stage)), jnp.zeros((2, 2, 3)), jax.random.key(0)
    refused = [
        lambda: pc.expected_cost(convex, M),
        lambda: pc.expected_gradient(convex, M, total=True),
        lambda: pc.best_response(convex, M),
        lambda: pc.residual(convex, M),
        lambda: pc.solve(convex, pc.RRM()),
        lambda: pc.solve(convex, pc.StablePoint()),
        lambda: pc.solve(convex, pc.RSGD(3, 0.1, gradient=pc.Exact()), key=key),
    ]
    for build in refused:
        assert_refused(build, "cost", "ConvexCost", "QuadraticCost", "pc.estimate_cost")


def test_swept_numbers_of_the_function_recompile_nothing():
    traces = []

    class Counting(Soft):
        def __call__(self, t, x, u):
            traces.append(None)
            return super().__call__(t, x, u)

    M, counts = jnp.zeros((2, 2, 3)), []
    for sharpness in (1.0, 2.0, 3.0):
        built, before = problem(pc.ConvexCost(Counting(jnp.asarray(sharpness)))), len(traces)
        pc.estimate_cost(built, M, key=jax.random.key(0), samples=8)
        counts.append(len(traces) - before)
    assert counts[0] > 0 and counts[1:] == [0, 0]


def check(function):
    pc.ConvexCost(function).check(3, 2, 4)


REFUSED = {
    "no function": (lambda: pc.ConvexCost(3.0), "function", "callable"),
    "vector": (lambda: check(lambda t, x, u: x), "function", "(3,)", "one real number"),
    "another signature": (lambda: check(lambda x, u: 0.0), "function", "accept t"),
    "branch on time": (lambda: check(lambda t, x, u: x @ x if t > 2 else u @ u), "function", "jnp.where"),
    "integers": (lambda: check(lambda t, x, u: t), "function", "real number"),
    "negative": (lambda: pc.ConvexCost(quadratic_stage, strong_convexity=-1.0), "strong_convexity", "-1.0"),
    "contradiction": (lambda: pc.ConvexCost(quadratic_stage, 2.0, 1.0), "strong_convexity", "smoothness 1.0"),
    "discount": (lambda: pc.ConvexCost(quadratic_stage, discount=-0.5), "discount", "-0.5", "(0, 1]"),
    "vector of constants": (
        lambda: pc.ConvexCost(quadratic_stage, gradient_bound=[1.0, 2.0]),
        "gradient_bound",
        "number",
    ),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_convex_cost_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
