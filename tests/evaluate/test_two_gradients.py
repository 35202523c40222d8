"""Evaluated and deployed: the gradient that stability is about, the one of optimality, and what jax.grad gives."""

import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc
from tests.solvers.problems import drifting, performative_prediction
from tests.tools import assert_close, normal


def test_jax_grad_of_the_performative_cost_is_the_total_gradient_and_not_the_partial_one():
    problem, M = drifting(0), 0.3 * normal(1, 2, 2, 3)
    automatic = jax.grad(lambda M: pc.expected_cost(problem, M))(M)
    partial, total = pc.expected_gradient(problem, M), pc.expected_gradient(problem, M, total=True)
    assert_close(automatic, total)
    assert float(jnp.linalg.norm(automatic - partial)) > 0.05 * float(jnp.linalg.norm(partial))


def test_jax_grad_with_the_deployed_policy_held_fixed_is_the_partial_gradient():
    problem, M = drifting(0), 0.3 * normal(1, 2, 2, 3)
    held = jax.grad(lambda M, deployed: pc.expected_cost(problem, M, deployed=deployed))(M, M)
    stopped = jax.grad(lambda M: pc.expected_cost(problem, M, deployed=jax.lax.stop_gradient(M)))(M)
    assert_close(held, pc.expected_gradient(problem, M))
    assert_close(stopped, pc.expected_gradient(problem, M))


def test_total_gradient_is_the_sum_of_the_two_partial_ones():
    problem, M = drifting(0), 0.3 * normal(1, 2, 2, 3)
    by_deployed = jax.grad(lambda deployed: pc.expected_cost(problem, M, deployed=deployed))(M)
    assert_close(pc.expected_gradient(problem, M) + by_deployed, pc.expected_gradient(problem, M, total=True))


def test_the_two_gradients_of_performative_mean_estimation_differ_by_the_reaction():
    """E (z - M)²/2 with z of mean 10 + M'/2: partial M/2 - 10, total half of that."""
    problem = performative_prediction(0.5)
    for M in (5.0, 30.0):
        at = np.full((1, 1, 1), M)
        assert_close(pc.expected_gradient(problem, at), np.full((1, 1, 1), 0.5 * M - 10))
        assert_close(pc.expected_gradient(problem, at, total=True), np.full((1, 1, 1), 0.5 * (0.5 * M - 10)))


def test_descent_along_the_wrong_gradient_ends_elsewhere():
    """Following jax.grad finds a cheaper policy that is not stable; the stable one is not the cheapest."""
    problem = drifting(0)
    stable = pc.solve(problem, pc.StablePoint()).M
    descend = jax.jit(
        lambda M: jax.lax.fori_loop(
            0, 5000, lambda _, M: M - 0.003 * jax.grad(lambda M: pc.expected_cost(problem, M))(M), M
        )
    )
    other = descend(stable)
    assert float(pc.expected_cost(problem, other)) < float(pc.expected_cost(problem, stable))
    assert float(pc.residual(problem, stable)) < 1e-10 < 1e-4 < float(pc.residual(problem, other))
    assert float(jnp.linalg.norm(pc.expected_gradient(problem, other, total=True))) < 1e-3
