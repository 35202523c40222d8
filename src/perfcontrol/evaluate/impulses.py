"""What the impulses w_s cost: quadratic forms in [I; M̂] with blocks S and D F⋯F B, summed over s.

Nothing is quadratic in the horizon: where F and B are constant the sums over time are taken before the products.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._linalg import Matrix, along_time, as_dense, transpose
from perfcontrol.evaluate.cost_to_go import CostToGo, World
from perfcontrol.evaluate.impulse_form import ImpulseForm
from perfcontrol.evaluate.stationary import StationaryWorld


def _chains(world: CostToGo, memory: int) -> tuple[list[Array], list[Array]]:
    """Y[d]_t = D_t F_{t-1} ⋯ F_{t-d}, (H, T+1, m, n), and X[d]_t, the block coupling lags j and j-d at t = s+j.

    X[0] = S and X[d] = Y[d-1]_t B_{t-d}, (H, T+1, m, m); zero where t < d.
    """
    length = len(world.Lambda) + 1

    def shifted(matrices: Matrix, d: int) -> Matrix:
        """matrices_{t-d} for t = 0..T, zero where t < d."""

        def shift(array: Array) -> Array:
            return jnp.concatenate([jnp.zeros((d, *array.shape[1:]), array.dtype), array])[:length]

        return jax.tree.map(shift, along_time(matrices, 2, length - 1))

    Y, X = [world.D], [world.S]
    for d in range(1, memory):
        X.append(Y[-1] @ shifted(world.B, d))
        Y.append(Y[-1] @ shifted(world.F, d))
    return Y, X


def tail_sums(matrices: Array, memory: int, length: int) -> Array:
    """Σ_{t ≥ j} of matrices_t for j = 1..memory, t up to length - 1; without a time axis, the same at every t."""
    if matrices.ndim == 2:
        return jnp.arange(length - 1, length - 1 - memory, -1, dtype=matrices.dtype)[:, None, None] * matrices
    late = (jnp.arange(length) >= memory).astype(matrices.dtype)
    parts = jnp.concatenate([matrices[1:memory], jnp.tensordot(late, matrices, 1)[None]])  # faster than any sum
    return jnp.flip(jnp.cumsum(jnp.flip(parts, axis=0), axis=0), axis=0)


def _chain_tails(world: CostToGo, memory: int) -> tuple[Array, Array]:
    """Σ_{t ≥ j} X[d]_t at index [d, j-1], (H, H, m, m), and Σ_{t > d} Y[d]_t, (H, m, n)."""
    length = len(world.Lambda) + 1
    if world.F.ndim == 3 or world.B.ndim == 3:
        Y, X = _chains(world, memory)
        # Y[d]_t is zero for t < d, and t = d would be the impulse w_{-1}.
        over_time = jnp.stack([jnp.sum(y[d + 1 :], axis=0) for d, y in enumerate(Y)])
        return jnp.stack([tail_sums(x, memory, length) for x in X]), over_time
    # The same matrices at every time: the sums come first, and nothing but Λ needs a pass over time.
    F, B = as_dense(world.F), as_dense(world.B)
    pulled = transpose(B) @ tail_sums(world.Lambda, memory, length - 1)
    curvature = pulled @ B + tail_sums(world.R, memory, length)
    coupling = pulled @ F if world.N is None else pulled @ F + tail_sums(world.N, memory, length)
    Y, X = [coupling], [curvature]
    for d in range(1, memory):  # lag j meets j - d where j ≥ d: Y loses its first
        X.append(jnp.pad(Y[-1][1:] @ B, ((d, 0), (0, 0), (0, 0))))
        Y.append(Y[-1][1:] @ F)
    return jnp.stack(X), jnp.stack([y[0] for y in Y])


def with_impulses(world: World, memory: int) -> World:
    """The world with its impulse form, where it has one: where the noise covariance is constant."""
    if world.noise_covariance.ndim == 3:
        return world
    return dataclasses.replace(world, impulses=impulse_form(world, memory))


def impulse_form(world: World, memory: int) -> ImpulseForm:
    """The blocks summed over impulses, by tail sums over time; in the stationary limit those of one impulse."""
    if world.impulses is not None:
        return world.impulses
    m = world.B.shape[-1]
    if isinstance(world, StationaryWorld):
        (X, Y), a = world.chains(memory), world.Lambda
    else:
        (X, Y), Lambda = _chain_tails(world, memory), world.Lambda
        a = Lambda[0] + tail_sums(Lambda, memory, len(Lambda))[0]  # sums that the chains need as well
    row, column = jnp.meshgrid(jnp.arange(memory), jnp.arange(memory), indexing="ij")
    blocks = X[jnp.abs(row - column), jnp.maximum(row, column)]
    blocks = jnp.where((row >= column)[..., None, None], blocks, transpose(blocks))
    G = blocks.transpose(0, 2, 1, 3).reshape(memory * m, memory * m)
    return ImpulseForm(G, Y.reshape(memory * m, -1), a)


def varying_impulses(world: CostToGo, M: Array, covariance: Array) -> tuple[Array, Array]:
    """Cost and gradient (H, m, n) of the impulses where the noise covariance (T, n, n) varies in time."""
    memory = M.shape[0]
    T = covariance.shape[0]
    Y, X = _chains(world, memory)

    def spread(array: Array, j: int) -> Array:
        """array_{s+j} for s = 0..T-1, zero past T."""
        pad = jnp.zeros((memory, *array.shape[1:]), array.dtype)
        return jnp.concatenate([array, pad])[j : j + T]

    fed = [M[i] @ covariance for i in range(memory)]  # M_i Σ_s
    linear = [jnp.einsum("tmn,tnk->mk", spread(Y[j - 1], j), covariance) for j in range(1, memory + 1)]
    curved = [jnp.zeros_like(M[0]) for _ in range(memory)]
    for j in range(1, memory + 1):
        for d in range(j):
            block = spread(X[d], j)
            curved[j - 1] += jnp.einsum("tab,tbn->an", block, fed[j - 1 - d])
            if d:
                curved[j - 1 - d] += jnp.einsum("tba,tbn->an", block, fed[j - 1])
    linear_all, curved_all = jnp.stack(linear), jnp.stack(curved)
    constant = jnp.einsum("tij,tji->", world.Lambda, covariance)
    return constant + jnp.sum(M * (2 * linear_all + curved_all)), 2 * (linear_all + curved_all)


def constant_impulses(world: World, M: Array, covariance: Array) -> tuple[Array, Array]:
    """Cost and gradient (H, m, n) of the impulses where the noise covariance (n, n) is constant."""
    form = impulse_form(world, M.shape[0])
    stacked = M.reshape(-1, M.shape[-1])
    curved = form.G @ stacked
    cost = jnp.sum(covariance * (form.a + transpose(stacked) @ (2 * form.F + curved)))
    return cost, (2 * (form.F + curved) @ covariance).reshape(M.shape)
