"""Best response on a general convex set: accelerated projected gradient steps, then semismooth Newton steps.

Newton works on the natural residual θ - Proj(θ - η g) through the derivative of the projection.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._linalg import frobenius, solve
from perfcontrol._programs import cond, numerics, program, while_loop
from perfcontrol.response.quadratic import Factors, Operator, Quadratic
from perfcontrol.sets import AbstractSet, Unconstrained

ACCELERATED_STEPS = 400  # before the first Newton step
PATIENCE = 50 * ACCELERATED_STEPS  # where Newton does not help, or is dear
NEWTON_STEPS = 30
KRYLOV = 30


@program
def projection_slope(feasible_set: AbstractSet, point: Any) -> Array:
    """The derivative (p, p) of the projection at `point` (policy_shape)."""
    size = point.size
    slope = jax.jacfwd(feasible_set.project)(point)
    return slope.reshape(size, size)


@program
def _project(feasible_set: AbstractSet, M: Any) -> Array:
    return feasible_set.project(M)


def nearest(feasible_set: AbstractSet, M: Any) -> Any:
    """The nearest policy of the set."""
    return M if isinstance(feasible_set, Unconstrained) else _project(feasible_set, M)


def gradient_steps(feasible_set: AbstractSet, gradient: Operator, step: Any, start: Any, count: int) -> Any:
    """`count` steps M ← Proj(M - step · gradient(M)) from `start`."""

    def advance(carry: Any) -> Any:
        M, taken = carry
        return nearest(feasible_set, M - step * gradient(M)), taken + 1

    xp, _ = numerics(start, step)
    return while_loop(lambda carry: carry[1] < count, advance, (start, xp.asarray(0)))[0]


class Projected:
    """The quadratic on a convex set."""

    def __init__(self, feasible_set: AbstractSet, form: Quadratic):
        self.feasible_set, self.form, self.step = feasible_set, form, form.step

    def minimise(self, start: Any) -> tuple[Any, Any]:
        """The minimiser, and whether it is the only one."""
        if self.form.matrix is None:
            return _approach_by_gradients(self.feasible_set, self.form, start), jnp.asarray(True)
        return _minimise(self.feasible_set, self.form, start)

    def newton(self, M: Any) -> Operator:
        """gradient -> the Newton step from near the minimiser M."""
        project, step = self.feasible_set.project, self.step
        if self.form.matrix is None:
            return lambda gradient: _newton_by_products(self.feasible_set, self.form, M, gradient)
        system, _ = _newton_system(self.feasible_set, self.form, M)
        factors = jax.scipy.linalg.lu_factor(system)

        def solve(gradient: Array) -> Array:
            moved = M - project(M - step * gradient)
            return -jax.scipy.linalg.lu_solve(factors, moved.reshape(-1)).reshape(M.shape)

        return solve

    def jacobian(self, M: Any, reaction: Any) -> Any:
        """Φ', (p, p), given 𝐄 = ∂_2 g, (p, p): the Newton step differentiated in its gradient."""
        system, slope = _newton_system(self.feasible_set, self.form, M)
        return -solve(system, self.step * slope @ reaction)


class ProjectedByFactors:
    """The quadratic given by its factors on a convex set: gradient steps, which need no Hessian, end in most cases.

    Args:
        feasible_set: the set. factors: of the quadratic. step: 1/‖𝐇‖. definite: whether 𝐇 is, beyond rounding.
        dense: the method that serves where they do not end, or 𝐇 is singular, and for derivatives.
    """

    def __init__(self, feasible_set: AbstractSet, factors: Factors, step: Any, definite: Any, dense: Callable[[], Any]):
        self.feasible_set, self.factors, self.step = feasible_set, factors, step
        self.definite, self.dense = definite, dense

    def minimise(self, start: Any) -> tuple[Any, Any]:
        """The minimiser, and whether it is the only one."""
        M, ended = _gradient_descent(self.feasible_set, self.factors, self.step, start)
        return cond(ended & self.definite, lambda: (M, self.definite), lambda: self.dense().minimise(M))

    def newton(self, M: Any) -> Operator:
        """gradient -> the Newton step from near the minimiser M."""
        return self.dense().newton(M)

    def jacobian(self, M: Any, reaction: Any) -> Any:
        """Φ', (p, p), given 𝐄 = ∂_2 g, (p, p)."""
        return self.dense().jacobian(M, reaction)


@program
def _gradient_descent(feasible_set: AbstractSet, factors: Factors, step: Any, start: Any) -> tuple[Array, Array]:
    """Where accelerated steps lead, and whether they have ended there."""
    form = Quadratic(factors.linear, step, None, factors.gradient)
    eps = float(jnp.finfo(start.dtype).eps)
    M = _accelerated(feasible_set, form, feasible_set.project(start), 40 * eps, PATIENCE)
    return M, frobenius(_natural_gap(feasible_set, form, M)) <= 100 * eps * _scale(form, M)


def _newton_by_products(feasible_set: AbstractSet, form: Quadratic, M: Array, gradient: Array) -> Array:
    """The same Newton step by GMRES, where the Hessian is not held."""
    project, step = feasible_set.project, form.step
    _, slope = jax.linearize(project, M - step * form.gradient(M))
    moved, _ = jax.scipy.sparse.linalg.gmres(
        lambda V: V - slope(V - step * (form.gradient(V) - form.linear)),
        M - project(M - step * gradient),
        tol=1e-10 if M.dtype == jnp.float64 else 1e-5,
        restart=min(KRYLOV, M.size),
        maxiter=KRYLOV,
        solve_method="incremental",
    )
    return -jnp.asarray(moved)


def _newton_system(feasible_set: AbstractSet, form: Quadratic, M: Any) -> tuple[Any, Any]:
    """A generalised Jacobian (p, p) of the natural residual, and the slope of the projection in it.

    A shift by rounding keeps a singular one (a minimiser that is not unique) solvable.
    """
    xp, _ = numerics(form, M)
    slope = projection_slope(feasible_set, M - form.step * form.gradient(M))
    eye = xp.eye(len(slope), dtype=slope.dtype)
    return (1 + xp.finfo(slope.dtype).eps) * eye - slope @ (eye - form.step * form.matrix), slope


@program
def _minimise(feasible_set: AbstractSet, form: Quadratic, start: Array) -> tuple[Array, Array]:
    eps = float(jnp.finfo(start.dtype).eps)

    def unsolved(carry: Any) -> Array:
        M, gap, _, tolerance, _ = carry
        return (gap > 4 * eps * _scale(form, M)) & (tolerance > eps)

    def approach(carry: Any) -> Any:
        # Newton may stall on the wrong face, from where no step of its own helps: then gradient steps again.
        M, *_, tolerance, limit = carry
        M, gap, system = _newton_steps(feasible_set, form, _accelerated(feasible_set, form, M, tolerance, limit))
        return M, gap, system, 1e-3 * tolerance, jnp.asarray(PATIENCE)

    far = jnp.asarray(jnp.inf, start.dtype)
    eye = jnp.eye(start.size, dtype=start.dtype)
    first = (
        feasible_set.project(start),
        far,
        eye,
        jnp.asarray(1e-5, start.dtype),
        jnp.asarray(ACCELERATED_STEPS),
    )
    M, _, system, *_ = jax.lax.while_loop(unsolved, approach, first)
    # On the active face the Hessian must be definite: the Jacobian has full rank.
    values = jnp.linalg.eigvalsh(system @ system.T)
    return M, values[0] > (M.size * eps * 100) ** 2 * jnp.maximum(values[-1], 1)


def _approach_by_gradients(feasible_set: AbstractSet, form: Quadratic, start: Array) -> Array:
    """Gradient steps alone, where the Hessian is not held."""
    eps = float(jnp.finfo(start.dtype).eps)
    return _accelerated(feasible_set, form, feasible_set.project(start), 40 * eps, PATIENCE)


def _natural_gap(feasible_set: AbstractSet, form: Quadratic, M: Array) -> Array:
    return M - feasible_set.project(M - form.step * form.gradient(M))


def _newton_steps(feasible_set: AbstractSet, form: Quadratic, M: Array) -> tuple[Array, Array, Array]:
    """Semismooth Newton steps while they help, the natural residual that they reach, its Jacobian."""
    eps = float(jnp.finfo(M.dtype).eps)

    def improve(carry: Any) -> Any:
        M, gap, count, *_ = carry
        residual = _natural_gap(feasible_set, form, M)
        system, _ = _newton_system(feasible_set, form, M)
        newton = feasible_set.project(M - jnp.linalg.solve(system, residual.reshape(-1)).reshape(M.shape))
        candidates = jnp.stack([newton, M - residual])  # a gradient step where Newton is not finite
        gaps = jax.vmap(lambda candidate: frobenius(_natural_gap(feasible_set, form, candidate)))(candidates)
        best = jnp.where(gaps[0] <= gaps[1], 0, 1)
        improved = gaps[best] < gap
        return jnp.where(improved, candidates[best], M), jnp.minimum(gaps[best], gap), count + 1, ~improved, system

    def helping(carry: Any) -> Array:
        M, gap, count, stuck, _ = carry
        return (count == 0) | ((gap > 4 * eps * _scale(form, M)) & (count < NEWTON_STEPS) & ~stuck)

    gap = frobenius(_natural_gap(feasible_set, form, M))
    eye = jnp.eye(M.size, dtype=M.dtype)
    M, gap, *_, system = jax.lax.while_loop(helping, improve, (M, gap, jnp.asarray(0), jnp.asarray(False), eye))
    return M, gap, system


def _scale(form: Quadratic, M: Array) -> Array:
    return frobenius(M) + frobenius(form.step * form.linear) + jnp.finfo(M.dtype).tiny


def _accelerated(feasible_set: AbstractSet, form: Quadratic, start: Array, tolerance: Any, limit: Any) -> Array:
    """Projected gradient steps with momentum, restarted when it points uphill."""

    def accelerate(carry: Any) -> Any:
        M, ahead, momentum, count, _ = carry
        following = feasible_set.project(ahead - form.step * form.gradient(ahead))
        grown = (1 + jnp.sqrt(1 + 4 * momentum**2)) / 2
        uphill = jnp.sum((ahead - following) * (following - M)) > 0
        ahead_next = following + jnp.where(uphill, 0, (momentum - 1) / grown) * (following - M)
        return following, ahead_next, jnp.where(uphill, 1, grown), count + 1, frobenius(following - ahead)

    def unfinished(carry: Any) -> Array:
        M, _, _, count, moved = carry
        return (moved > tolerance * _scale(form, M)) & (count < limit)

    one, far = jnp.ones((), start.dtype), jnp.asarray(jnp.inf, start.dtype)
    return jax.lax.while_loop(unfinished, accelerate, (start, start, one, jnp.asarray(0), far))[0]
