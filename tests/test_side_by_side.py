"""Functions whose copies stand side by side under vmap, against one call a copy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol._side_by_side import side_by_side
from perfcontrol.evaluate.adjoint import mean_path_gradient
from perfcontrol.evaluate.rollout import sample_path
from perfcontrol.evaluate.time_loop import time_loop
from tests.tools import assert_close, normal


def _step(fixed, x, step):
    following = fixed[0] * x + jnp.sum(step * x, axis=0)
    return following, following


def _looped(a, x, steps):
    return time_loop(_step, (a,), x, steps, together=True)


def _plain(a, x, steps):
    return jax.lax.scan(lambda x, step: _step((a,), x, step), x, steps)[1]


@pytest.mark.float32
@pytest.mark.parametrize("axes", [(0, 0, 0), (None, 0, 0), (0, None, None), (None, None, 0), (None, 1, 2)])
def test_copies_of_a_time_loop_are_what_single_calls_give(axes):
    arguments = []
    for number, (axis, shape) in enumerate(zip(axes, [(), (4,), (6, 4)], strict=True)):
        alone = shape if axis is None else (*shape[:axis], 3, *shape[axis:])
        arguments.append(jnp.asarray(normal(number, *alone)))
    together = jax.vmap(_looped, axes)(*arguments)
    each = jax.vmap(_plain, axes)(*arguments)
    assert together.shape == each.shape
    assert_close(together, each, 1e-12, 1e-5)


def test_derivatives_in_both_modes_are_those_of_the_plain_loop():
    x, steps = normal(1, 4), normal(2, 6, 4)

    def total(loop):
        return lambda a: jnp.sum(jax.vmap(lambda shift: loop(a, x + shift, steps))(jnp.arange(3.0)) ** 2)

    for differentiate in (jax.grad, jax.jacfwd):
        assert_close(differentiate(total(_looped))(0.7), differentiate(total(_plain))(0.7), 1e-12)


@pytest.mark.parametrize("copies", [3, 6])  # the second is the length of the loop: axes exchanged would not be noticed
@pytest.mark.parametrize("axis", [0, 1])
def test_derivatives_taken_after_the_copies_were_traced_are_those_of_the_plain_loop(copies, axis):
    x, steps, weight = normal(1, 4), normal(2, 6, 4), normal(3, copies, 6, 4)

    def total(loop):
        def traced(a):
            one = lambda index: loop(a, x + index, steps) if axis == 0 else loop(a, x, steps * (1 + index))  # noqa: E731
            return jnp.sum(weight * jax.lax.map(one, jnp.arange(copies, dtype=a.dtype), batch_size=copies) ** 2)

        return traced

    a = jnp.asarray(0.7)
    for differentiate in (jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f)), lambda f: jax.jit(jax.grad(f))):
        assert_close(differentiate(total(_looped))(a), differentiate(total(_plain))(a), 1e-12)
    many = jnp.asarray([0.7, 0.2])
    assert_close(jax.vmap(jax.grad(total(_looped)))(many), jax.vmap(jax.grad(total(_plain)))(many), 1e-12)


def test_what_all_copies_share_has_one_last_entry():
    seen = []

    def function(a, b):
        seen.append((a.shape, b.shape))
        return a * b

    jax.vmap(side_by_side(function), (0, None))(jnp.ones((5, 2)), jnp.ones(2))
    assert seen[-1] == ((2, 5), (2, 1))


@pytest.mark.float32
@pytest.mark.parametrize("law", ["uniform", "rademacher", "truncated_gaussian", "gaussian", "sphere"])
@pytest.mark.parametrize("make_key", [pc.fast_key, jax.random.key], ids=["fast", "default"])
def test_gradients_of_dense_paths_do_not_depend_on_batching(law, make_key):
    """The same draws, and the same numbers up to the order of additions."""
    problem = _problem(pc.DensePerturbation(lambda M: 0.1 * jnp.sqrt(1 + jnp.sum(M**2)), law=law, mean=0.1 * np.eye(3)))
    policies = 0.1 * jnp.asarray(normal(7, 5, *problem.policy_shape))
    keys = jax.random.split(make_key(1), 5)

    def one(M, key):
        return mean_path_gradient(problem, M, M, key, 1)

    alone = jnp.stack([one(M, key) for M, key in zip(policies, keys, strict=True)])
    assert_close(jax.vmap(one)(policies, keys), alone, 1e-12, 1e-4)


@pytest.mark.parametrize("count", [1, 8])
def test_matrices_of_a_key_are_the_same_bits_in_any_batch(count):
    problem = _problem(pc.DensePerturbation(0.3))
    M = problem.lift(problem.initial_policy())
    keys = jax.random.split(pc.fast_key(2), count)
    drawn = jax.jit(jax.vmap(lambda key: sample_path(problem, M, M, key).draws.dense()))(keys)
    alone = jax.jit(lambda key: sample_path(problem, M, M, key).draws.dense())
    assert np.array_equal(drawn, jnp.stack([alone(key) for key in keys]))


def _problem(perturbation):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * np.eye(3) + 0.1 * np.ones((3, 3)), np.eye(3, 2)),
        horizon=5,
        memory=2,
        gain=0.1 * np.ones((2, 3)),
        noise=pc.Rademacher(np.ones(3)),
        cost=pc.QuadraticCost(np.eye(3), 0.1 * np.eye(2)),
        perturbation=perturbation,
        initial_state=np.ones(3),
    )
