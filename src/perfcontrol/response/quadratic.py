"""C_T(·; M') as a convex quadratic in the free parameters θ, with gradient linear + 𝐇 θ."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._linalg import symmetrise
from perfcontrol._programs import Numbers, known, numerics, on_host, program
from perfcontrol.evaluate.cost_to_go import World
from perfcontrol.evaluate.exact import weigh
from perfcontrol.evaluate.impulses import impulse_form
from perfcontrol.evaluate.mean_path import sustained_form
from perfcontrol.problem import PerformativeProblem
from perfcontrol.sets import FullStructure

DENSE_LIMIT = 2048  # free parameters up to which the Hessian is held as a matrix

Operator = Callable[[Any], Any]


class Quadratic(eqx.Module):
    """gradient(θ) = linear + 𝐇 θ.

    linear: policy_shape. step: η = 1/‖𝐇‖. matrix: 𝐇, (p, p), where held; else `passes` gives gradients by passes
    over time.
    """

    linear: Numbers
    step: Numbers
    matrix: Numbers | None
    passes: Operator | None = None

    def gradient(self, M: Any) -> Any:
        """The gradient at M: a product with the matrix where that is held, else a pass over time."""
        if self.matrix is None:
            assert self.passes is not None
            return self.passes(M)
        return self.linear + (self.matrix @ M.reshape(-1)).reshape(M.shape)


def stationary(world: World) -> bool:
    """Whether noise mean and covariance are constant in time (known from shapes)."""
    return world.noise_mean.ndim == 1 and world.noise_covariance.ndim == 2


class Factors(NamedTuple):
    """The same quadratic for constant noise moments: gradient(M̂) = linear + 2 (G M̂ Σ + G̃ M̂ w̄w̄ᵀ), lifted.

    linear: policy shape. G, G_mean: G and G̃, (H m, H m). Sigma, w: covariance and mean of the noise. G_mean and w are
    None where the mean is zero.
    """

    linear: Any
    G: Any
    G_mean: Any
    Sigma: Any
    w: Any

    @property
    def matrix(self) -> Any:
        """𝐇, (p, p)."""
        xp, _ = numerics(self.G, self.Sigma)
        matrix = xp.kron(self.G, self.Sigma)
        return 2 * (matrix if self.w is None else matrix + xp.kron(self.G_mean, xp.outer(self.w, self.w)))

    def gradient(self, M: Any) -> Any:
        """The gradient at M."""
        stacked = M.reshape(-1, M.shape[-1])
        curved = self.G @ stacked @ self.Sigma
        if self.w is not None:
            curved = curved + (self.G_mean @ (stacked @ self.w))[:, None] * self.w
        return self.linear + 2 * curved.reshape(M.shape)


_impulse_form, _sustained_form = program(impulse_form), program(sustained_form)


def factors(problem: PerformativeProblem, world: World, centred: bool = False) -> Factors:
    """The factors of a given world; `centred`: the mean of the noise is known to be zero."""
    form = _impulse_form(world, problem.memory) if world.impulses is None else world.impulses
    form, Sigma, w = on_host((form, world.noise_covariance, world.noise_mean))
    if centred or (known(w) and not np.any(w)):  # nothing has a mean that the policy could act on
        return Factors(2 * (form.F @ Sigma).reshape(problem.lifted_shape), form.G, None, Sigma, None)
    linear = weigh(problem, world, np.zeros(problem.policy_shape, world.Lambda.dtype))[1]
    return Factors(linear, form.G, _sustained_form(world, problem.memory), Sigma, w)


@program
def quadratic(problem: PerformativeProblem, world: World) -> Quadratic:
    """The quadratic of a given world, its Hessian as a matrix."""
    zero = jnp.zeros(problem.policy_shape, world.Lambda.dtype)
    linear = weigh(problem, world, zero)[1]
    matrix = hessian_matrix(problem, world, linear)
    return Quadratic(linear, 1 / largest_eigenvalue(matrix), matrix)


def quadratic_by_passes(problem: PerformativeProblem, world: World) -> Quadratic:
    """The same without a matrix: gradients by its factors where there are such, else by a pass over time each."""
    if stationary(world) and isinstance(problem.structure, FullStructure):
        form = factors(problem, world)
        return Quadratic(form.linear, 1 / _power_iteration(form.gradient, form.linear), None, form.gradient)

    def gradient(M: Array) -> Array:
        return weigh(problem, world, M)[1]

    linear = gradient(jnp.zeros(problem.policy_shape, world.Lambda.dtype))
    return Quadratic(linear, 1 / _power_iteration(gradient, linear), None, gradient)


def hessian_matrix(problem: PerformativeProblem, world: World, linear: Array) -> Array:
    """The Hessian in the free parameters (p, p)."""
    size = linear.size
    if stationary(world):
        of, shape, w = problem.structure.product_matrix, problem.policy_shape, world.noise_mean
        driven = of(impulse_form(world, problem.memory).G, world.noise_covariance, shape)
        held = of(sustained_form(world, problem.memory), jnp.outer(w, w), shape)
        return symmetrise(2 * (driven + held))

    def column(direction: Array) -> Array:
        return (weigh(problem, world, direction.reshape(linear.shape))[1] - linear).reshape(-1)

    return symmetrise(jax.lax.map(column, jnp.eye(size, dtype=linear.dtype), batch_size=min(64, size)))


def largest_eigenvalue(matrix: Array) -> Array:
    """An upper bound within rounding of ‖matrix‖ for a PSD matrix by power iteration on it, never zero."""
    tiny = jnp.finfo(matrix.dtype).tiny
    unit = jnp.maximum(jnp.max(jnp.abs(matrix)), tiny)  # squares would overflow
    matrix = matrix / unit

    def improve(_: Any, v: Array) -> Array:
        v = matrix @ v
        return v / jnp.maximum(jnp.linalg.norm(v), tiny)

    start = jnp.sqrt(jnp.sum(matrix**2, axis=0)) + tiny
    v = jax.lax.fori_loop(0, 30, improve, start / jnp.maximum(jnp.linalg.norm(start), tiny))
    # 30 steps may stop below the norm: a tenth more keeps projected gradient steps stable.
    estimate = 1.1 * (v @ matrix @ v)
    return unit * jnp.maximum(jnp.minimum(estimate, jnp.trace(matrix)), jnp.finfo(matrix.dtype).eps)


def _power_iteration(gradient: Operator, linear: Array) -> Array:
    """The same estimate where only products are available."""
    tiny = jnp.finfo(linear.dtype).tiny

    def improve(_: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        v, _norm = carry
        image = gradient(v) - linear
        unit = jnp.maximum(jnp.max(jnp.abs(image)), tiny)  # squares would overflow
        image = image / unit
        norm = jnp.sqrt(jnp.sum(image**2))
        return image / jnp.maximum(norm, tiny), norm * unit

    start = jnp.ones_like(linear) / math.sqrt(linear.size)
    _, norm = jax.lax.fori_loop(0, 50, improve, (start, jnp.zeros((), linear.dtype)))
    return jnp.maximum(1.2 * norm, tiny)
