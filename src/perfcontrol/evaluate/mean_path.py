"""What the deterministic part costs: the path of the means of noise, feedforward and initial state.

Λ carries the multiplicative noise that the mean path excites.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._linalg import along_time, as_dense, matvec, rmatvec
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.cost_to_go import CostToGo, World
from perfcontrol.evaluate.impulses import tail_sums
from perfcontrol.evaluate.rollout import input_adjoint, input_term
from perfcontrol.evaluate.stationary import StationaryWorld
from perfcontrol.problem import PerformativeProblem


def mean_path(problem: PerformativeProblem, world: CostToGo, v: Array, w: Array, x0: Array) -> tuple[Array, Array]:
    """Expected cost of the deterministic part v (T+1, m), w (T, n), x_0, and its gradient by v, (T+1, m).

    The multiplicative noise that the mean path excites is included: Λ carries it.
    """
    n, T = problem.state_size, problem.horizon
    cost = problem.cost
    assert isinstance(cost, QuadraticCost)
    push = input_term(world.B, v) + w
    moved = _each(world.Lambda, push)
    source, by_input_stage, constant = jnp.zeros((T + 1, n), v.dtype), 0, 0
    if cost.has_targets:
        linear, constant = cost.linear_terms(T)
        by_input_stage = linear[:, n:]
        source = linear[:, :n] - problem.feedback_adjoint(by_input_stage)
    if world.N is not None:
        source = source + (v @ world.N if world.N.ndim == 2 else rmatvec(world.N, v))

    def turned(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.flip(leaf, 0), tree)

    # One loop goes both ways, forward with the mean state and backward with p: neither needs the other.
    varying = (world.F, turned(world.F)) if world.F.ndim == 3 else None

    def go(carry: tuple[Array, Array], step: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        (mu, p), (F_t, push_t, (source_t, moved_t)) = carry, step
        F, F_back = (world.F, world.F) if F_t is None else F_t
        mu = matvec(F, mu) + push_t
        return (mu, source_t + rmatvec(F_back, moved_t + p)), (mu, p)

    steps = varying, push, turned((source[:-1], moved))
    (_, p0), (mu, p_next) = jax.lax.scan(go, (x0, source[-1]), steps)
    p_next = turned(p_next)
    # x' Λ x + 2 p' x is what lies ahead: each push adds its own to it, and by_v is what it adds at the margin.
    total = x0 @ (world.first @ x0 + 2 * p0) + jnp.sum(push * (moved + 2 * p_next)) + jnp.sum(constant)
    weighed = v @ world.R if world.R.ndim == 2 else matvec(world.R, v)
    total = total + jnp.sum(v * (weighed + 2 * by_input_stage))
    margin = input_adjoint(world.B, _each(world.Lambda, mu) + p_next)
    by_v = weighed + by_input_stage + jnp.pad(margin, ((0, 1), (0, 0)))
    if world.N is not None:
        states = jnp.concatenate([x0[None], mu])
        by_v = by_v + (states @ world.N.T if world.N.ndim == 2 else matvec(world.N, states))
    return total, 2 * by_v


def _each(matrices: Array, vectors: Array) -> Array:
    """matrix_t @ vector_t for every t, by a library call: outside of loops faster than multiply-and-sum."""
    return (matrices @ vectors[..., None])[..., 0]


def sustained_form(world: World, memory: int) -> Array:
    """(H m, H m): the quadratic form that constant feedforwards ṽ_i, held from time i on, meet (i = 1..H)."""
    if isinstance(world, StationaryWorld):  # in the long run the lags do not differ
        return jnp.tile(world.sustained(), (memory, memory))
    T, m, D = len(world.Lambda), world.B.shape[-1], world.D
    varying = world.F.ndim == 3

    def back(Y: Array, step: Any) -> tuple[Array, Array]:
        F_t, D_t = step
        Y = D_t + Y @ (F_t if varying else world.F)
        return Y, Y

    # Y_t = D_t + Y_{t+1} F_t: what a state at time t couples to from then on.
    _, Y = jax.lax.scan(back, D[T], (world.F if varying else None, D[:T]), reverse=True)
    Y = jnp.concatenate([Y, D[T:]])
    B = as_dense(world.B)
    later = tail_sums(Y[1:] @ B, memory, T) if B.ndim == 3 else tail_sums(Y[1:], memory, T) @ B  # pushes from a on
    latest = jnp.maximum(*jnp.indices((memory, memory)))
    coupled = later[latest].transpose(0, 2, 1, 3)  # (a, m, b, m): at times t >= a, by what is held from b on
    if memory > 1:
        coupled = coupled + _pushed_before(world, Y, memory)
    coupled = coupled.reshape(memory * m, memory * m)
    held = tail_sums(world.S, memory, T + 1)[latest]
    return coupled + coupled.T + held.transpose(0, 2, 1, 3).reshape(memory * m, memory * m)


def _pushed_before(world: CostToGo, Y: Array, memory: int) -> Array:
    """Y_a X_a, (H, m, H, m), where X_a is the state at time a that feedforwards held from b < a on have led to."""
    n, m = world.B.shape[-2:]
    F, B = (as_dense(along_time(matrix, 2, len(world.Lambda)))[1:memory] for matrix in (world.F, world.B))
    held = (jnp.arange(1, memory)[:, None] >= jnp.arange(1, memory + 1)).astype(Y.dtype)

    def advance(X: Array, step: Any) -> tuple[Array, Array]:
        F_t, B_t, held_t = step
        X = F_t @ X + (B_t[:, None, :] * held_t[:, None]).reshape(n, -1)
        return X, X

    _, X = jax.lax.scan(advance, jnp.zeros((n, memory * m), Y.dtype), (F, B, held))
    return jnp.pad(Y[2 : memory + 1] @ X, ((1, 0), (0, 0), (0, 0))).reshape(memory, m, memory, m)
