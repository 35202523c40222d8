"""The best response Φ(M') = argmin over the feasible set of C_T(·; M'), exactly, for quadratic stage costs.

C_T(·; M') is a convex quadratic in the free parameters θ. One engine serves best responses, repeated
minimisation, stable points and theory:

- *separable*: constant noise moments, no structure, no constraint: the Hessian is 2 (G ⊗ Σ + G̃ ⊗ w̄w̄ᵀ) and two
  solves with H m unknowns give the minimiser;
- *affine* (unconstrained or an affine set): one symmetric solve in the tangent space, least norm if singular;
- otherwise accelerated projected gradient steps, then semismooth Newton steps on the natural residual
  θ - Proj(θ - η g) through the derivative of the projection.

Iterations run on frozen numbers; the derivative of Φ comes from one Newton step at the minimiser (implicit function
theorem), never from differentiating a loop.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import check_finite
from perfcontrol._linalg import frobenius, symmetrise
from perfcontrol.evaluate.exact import (
    CostToGo,
    cost_and_gradient,
    cost_to_go,
    exact_gradient,
    impulse_form,
    require_moments,
    sustained_form,
)
from perfcontrol.evaluate.rollout import check_pair
from perfcontrol.problem import PerformativeProblem
from perfcontrol.sets import FullStructure, Unconstrained

DENSE_LIMIT = 2048  # free parameters up to which the Hessian is held as a matrix
ACCELERATED_STEPS = 400
NEWTON_STEPS = 30

Operator = Callable[[Array], Array]


class Response(NamedTuple):
    """A best response M (of least norm on affine sets), whether it is the only one, and how far the deployed policy is
    from being it: `residual`, the relative natural residual of the deployed policy in the world that it makes."""

    M: Array
    unique: Array
    residual: Array


class Quadratic(NamedTuple):
    """C_T(·; M') as gradient(θ) = linear + hessian θ in the free parameters, with η = 1/‖hessian‖.

    Where the Hessian is held as a matrix, `gradient` is a product with it, not a pass over time.
    """

    linear: Array
    gradient: Operator
    step: Array
    matrix: Array | None  # (p, p) where held


def _stationary(world: CostToGo) -> bool:
    """Whether noise mean and covariance are constant in time (known from shapes)."""
    return world.noise_mean.ndim == 1 and world.noise_covariance.ndim == 2


def _gradient_at(problem: PerformativeProblem, world: CostToGo) -> Operator:
    def gradient(M: Array) -> Array:
        return problem.structure.adjoint(cost_and_gradient(problem, world, problem.structure.lift(M))[1])

    return gradient


def quadratic(problem: PerformativeProblem, world: CostToGo) -> Quadratic:
    """The quadratic C_T(·; M') of a given world."""
    gradient = _gradient_at(problem, world)
    shape, dtype = problem.policy_shape, world.S.dtype
    linear = gradient(jnp.zeros(shape, dtype))
    size = math.prod(shape)
    if size <= DENSE_LIMIT:
        matrix = _hessian_matrix(problem, world, gradient, linear)

        def product(M: Array) -> Array:
            return linear + (matrix @ M.reshape(-1)).reshape(shape)

        return Quadratic(linear, product, 1 / _largest_eigenvalue(matrix, dtype), matrix)
    return Quadratic(linear, gradient, 1 / _power_iteration(gradient, linear), None)


def _hessian_matrix(problem: PerformativeProblem, world: CostToGo, gradient: Operator, linear: Array) -> Array:
    """The Hessian in the free parameters (p, p)."""
    size = linear.size
    if _stationary(world):
        H, m, _ = problem.lifted_shape
        w = world.noise_mean
        G = impulse_form(world, H).G
        blocks = jnp.stack([G, sustained_form(world, H)]).reshape(2, H, m, H, m)
        right = jnp.stack([world.noise_covariance, jnp.outer(w, w)])

        def column(direction: Array) -> Array:
            V = problem.structure.lift(direction.reshape(linear.shape))
            image = jnp.einsum("kimjl,jln,kno->imo", blocks, V, right, optimize="optimal")
            return 2 * problem.structure.adjoint(image).reshape(-1)

    else:

        def column(direction: Array) -> Array:
            return (gradient(direction.reshape(linear.shape)) - linear).reshape(-1)

    return symmetrise(jax.lax.map(column, jnp.eye(size, dtype=linear.dtype), batch_size=min(64, size)))


def _largest_eigenvalue(matrix: Array, dtype: Any) -> Array:
    """An upper bound within rounding of ‖matrix‖ for a PSD matrix by power iteration on it, never zero."""

    def improve(_: Any, v: Array) -> Array:
        v = matrix @ v
        return v / jnp.maximum(jnp.linalg.norm(v), jnp.finfo(dtype).tiny)

    size = matrix.shape[0]
    start = jnp.sqrt(jnp.sum(matrix**2, axis=0)) + jnp.finfo(dtype).tiny
    v = jax.lax.fori_loop(0, 30, improve, start / jnp.linalg.norm(start))
    # 30 steps may stop below the norm: a tenth more keeps projected gradient steps stable.
    estimate = 1.1 * (v @ matrix @ v)
    return jnp.maximum(jnp.minimum(estimate, jnp.trace(matrix)), jnp.finfo(dtype).tiny * size)


def _power_iteration(gradient: Operator, linear: Array) -> Array:
    """The same estimate where only products are available."""
    tiny = jnp.finfo(linear.dtype).tiny

    def improve(_: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        v, _norm = carry
        image = gradient(v) - linear
        norm = jnp.sqrt(jnp.sum(image**2))
        return image / jnp.maximum(norm, tiny), norm

    start = jnp.ones_like(linear) / math.sqrt(linear.size)
    _, norm = jax.lax.fori_loop(0, 50, improve, (start, jnp.zeros((), linear.dtype)))
    return jnp.maximum(1.2 * norm, tiny)


def natural_residual(problem: PerformativeProblem, world: CostToGo, M: Array, step: Array) -> Array:
    """‖M - Proj(M - η g)‖_F relative to ‖M‖_F + η ‖g(0)‖_F, η = 1/‖Hessian‖; g by a pass over time of its own."""
    at_zero, at_M = jax.vmap(_gradient_at(problem, world))(jnp.stack([jnp.zeros_like(M), M]))
    moved = frobenius(M - problem.feasible_set.project(M - step * at_M))
    scale = frobenius(M) + step * frobenius(at_zero)
    relative = moved / jnp.where(scale > 0, scale, 1)
    # A world that overflows has a zero step, and would pass for stable.
    return jnp.where(jnp.all(jnp.isfinite(at_M)) & (step > 0), relative, jnp.inf)


# --- methods: each minimises one quadratic over its kind of set, and gives Newton steps at a minimiser ---------------


def _pseudo_inverse(matrix: Array, scale: Array) -> tuple[Array, Array]:
    """matrix⁺ of a PSD matrix, and its numerical rank; eigenvalues that are rounding beside `scale` count as zero."""
    values, vectors = jnp.linalg.eigh(matrix)
    threshold = scale * matrix.shape[0] * jnp.finfo(matrix.dtype).eps
    kept = values > threshold
    inverse = jnp.where(kept, 1 / jnp.where(kept, values, 1), 0)
    return (vectors * inverse) @ vectors.T, jnp.sum(kept)


class _Affine:
    """The set is an affine subspace: one symmetric solve in its tangent space, least norm where singular."""

    def __init__(self, problem: PerformativeProblem, form: Quadratic):
        self.form, self.step = form, form.step
        shape, dtype, size = form.linear.shape, form.linear.dtype, form.linear.size
        self.origin = problem.feasible_set.project(jnp.zeros(shape, dtype))
        self.unique = jnp.asarray(True)

        def tangent(V: Array) -> Array:
            return problem.feasible_set.project(V) - self.origin

        if form.matrix is None:
            self.solve = self._conjugate_gradients(tangent)
            return
        if isinstance(problem.feasible_set, Unconstrained):
            inverse, rank = _pseudo_inverse(form.matrix, 1 / form.step)
            dimension = jnp.asarray(size)
        else:
            P = jax.vmap(lambda row: tangent(row.reshape(shape)).reshape(-1))(jnp.eye(size, dtype=dtype))
            # By the size of the whole Hessian: on a set of one point what is left of it is rounding alone.
            inverse, rank = _pseudo_inverse(symmetrise(P @ form.matrix @ P), 1 / form.step)
            inverse = P @ inverse @ P
            dimension = jnp.round(jnp.trace(P))
        self.unique = rank >= dimension
        self.inverse = inverse
        self.solve = lambda gradient: -(inverse @ gradient.reshape(-1)).reshape(shape)

    def _conjugate_gradients(self, tangent: Operator) -> Operator:
        """For more parameters than `DENSE_LIMIT`; started at zero, so it finds the least-norm solution."""
        form = self.form

        def hessian(V: Array) -> Array:
            return tangent(form.gradient(tangent(V)) - form.linear)

        tolerance = 20 * float(jnp.finfo(form.linear.dtype).eps)

        def solve(gradient: Array) -> Array:
            right = -tangent(tangent(gradient))
            # What rounding leaves of a gradient need not be in the range of the Hessian: never chase it.
            rounding: Any = tolerance * (frobenius(gradient) + frobenius(form.linear))
            found = jax.scipy.sparse.linalg.cg(hessian, right, tol=tolerance, atol=rounding, maxiter=10 * right.size)[0]
            return tangent(found)

        return solve

    def minimise(self, start: Array) -> tuple[Array, Array]:
        M = self.origin + self.solve(self.form.gradient(self.origin))
        return M + self.solve(self.form.gradient(M)), self.unique  # one step of iterative refinement

    def newton(self, M: Array) -> Operator:
        return self.solve


class _Projected:
    """A general convex set: accelerated projected gradient steps, then semismooth Newton on the natural residual."""

    def __init__(self, problem: PerformativeProblem, form: Quadratic):
        self.project, self.form, self.step = problem.feasible_set.project, form, form.step
        self.eye = jnp.eye(form.linear.size, dtype=form.linear.dtype)

    def residual(self, M: Array) -> Array:
        return M - self.project(M - self.step * self.form.gradient(M))

    def jacobian(self, M: Array) -> Array:
        """A generalised Jacobian (p, p) of the natural residual."""
        assert self.form.matrix is not None
        shape = M.shape
        point = M - self.step * self.form.gradient(M)
        slope = jax.jacfwd(lambda v: self.project(v.reshape(shape)).reshape(-1))(point.reshape(-1))
        return self.eye - slope @ (self.eye - self.step * self.form.matrix)

    def minimise(self, start: Array) -> tuple[Array, Array]:
        eps = float(jnp.finfo(start.dtype).eps)
        if self.form.matrix is None:
            return self._accelerated(self.project(start), 40 * eps, 50 * ACCELERATED_STEPS), jnp.asarray(True)

        def unsolved(carry: Any) -> Array:
            M, gap, *_, tolerance = carry
            return (gap > 4 * eps * self._scale(M)) & (tolerance > eps)

        def approach(carry: Any) -> Any:
            # Newton may stall on the wrong face, from where no step of its own helps: then gradient steps again.
            M, *_, tolerance = carry
            M, gap, slope = self._newton_steps(self._accelerated(M, tolerance, ACCELERATED_STEPS))
            return M, gap, slope, 1e-3 * tolerance

        far = jnp.asarray(jnp.inf, start.dtype)
        first = (self.project(start), far, self.eye, jnp.asarray(1e-5, start.dtype))
        M, _, slope, _ = jax.lax.while_loop(unsolved, approach, first)
        # On the active face the Hessian must be definite: the Jacobian has full rank.
        values = jnp.linalg.eigvalsh(slope @ slope.T)
        return M, values[0] > (M.size * eps * 100) ** 2 * jnp.maximum(values[-1], 1)

    def _newton_steps(self, M: Array) -> tuple[Array, Array, Array]:
        """Semismooth Newton steps while they help, the natural residual that they reach, its Jacobian."""
        eps = float(jnp.finfo(M.dtype).eps)

        def improve(carry: Any) -> Any:
            M, gap, count, *_ = carry
            fallback = self.project(M - self.step * self.form.gradient(M))
            # The small shift keeps a singular Jacobian (a minimiser that is not unique) solvable.
            slope = self.jacobian(M)
            right = self.residual(M).reshape(-1)
            newton = self.project(M - jnp.linalg.solve(slope + eps * self.eye, right).reshape(M.shape))
            candidates = jnp.stack([newton, fallback])
            gaps = jax.vmap(lambda candidate: frobenius(self.residual(candidate)))(candidates)
            best = jnp.where(gaps[0] <= gaps[1], 0, 1)  # the fallback where Newton is not finite
            improved = gaps[best] < gap
            return (
                jnp.where(improved, candidates[best], M),
                jnp.minimum(gaps[best], gap),
                count + 1,
                ~improved,
                slope,
            )

        def helping(carry: Any) -> Array:
            M, gap, count, stuck, _ = carry
            return (count == 0) | ((gap > 4 * eps * self._scale(M)) & (count < NEWTON_STEPS) & ~stuck)

        first = (M, frobenius(self.residual(M)), jnp.asarray(0), jnp.asarray(False), self.eye)
        M, gap, *_, slope = jax.lax.while_loop(helping, improve, first)
        return M, gap, slope

    def _scale(self, M: Array) -> Array:
        return frobenius(M) + self.step * frobenius(self.form.linear) + jnp.finfo(M.dtype).tiny

    def _accelerated(self, start: Array, tolerance: Any, limit: int) -> Array:
        """Projected gradient steps with momentum, restarted when it points uphill."""

        def accelerate(carry: Any) -> Any:
            M, ahead, momentum, count, _ = carry
            following = self.project(ahead - self.step * self.form.gradient(ahead))
            grown = (1 + jnp.sqrt(1 + 4 * momentum**2)) / 2
            uphill = jnp.sum((ahead - following) * (following - M)) > 0
            ahead_next = following + jnp.where(uphill, 0, (momentum - 1) / grown) * (following - M)
            return following, ahead_next, jnp.where(uphill, 1, grown), count + 1, frobenius(following - ahead)

        def unfinished(carry: Any) -> Array:
            M, _, _, count, moved = carry
            return (moved > tolerance * self._scale(M)) & (count < limit)

        one, far = jnp.ones((), start.dtype), jnp.asarray(jnp.inf, start.dtype)
        return jax.lax.while_loop(unfinished, accelerate, (start, start, one, jnp.asarray(0), far))[0]

    def newton(self, M: Array) -> Operator:
        if self.form.matrix is None:
            return lambda gradient: self.project(M - self.step * gradient) - M
        factors = jax.scipy.linalg.lu_factor(self.jacobian(M) + jnp.finfo(M.dtype).eps * self.eye)

        def solve(gradient: Array) -> Array:
            moved = M - self.project(M - self.step * gradient)
            return -jax.scipy.linalg.lu_solve(factors, moved.reshape(-1)).reshape(M.shape)

        return solve


class _Separable:
    """Unconstrained, unstructured, constant noise moments: the Hessian is 2 (G ⊗ Σ + G̃ ⊗ w̄w̄ᵀ).

    With a = Σ^{-1/2} w̄ and Y = M̂ Σ^{1/2}: the part of Y across a meets G alone, the part along a G + |a|² G̃: two
    solves with H m unknowns. Where G or Σ is singular, the dense method serves.
    """

    def __init__(self, problem: PerformativeProblem, world: CostToGo):
        self.problem, self.world = problem, world
        H, m, n = self.shape = problem.lifted_shape
        G, G_mean = impulse_form(world, H).G, sustained_form(world, H)
        Sigma, w = world.noise_covariance, world.noise_mean
        eps = jnp.finfo(G.dtype).eps
        G_values, self.G_vectors = jnp.linalg.eigh(G)
        S_values, S_vectors = jnp.linalg.eigh(Sigma)
        self.regular = (G_values[0] > H * m * eps * G_values[-1]) & (S_values[0] > n * eps * S_values[-1])
        self.G_values = jnp.where(G_values > 0, G_values, 1)
        largest = 2 * (G_values[-1] * S_values[-1] + jnp.trace(G_mean) * (w @ w))
        self.step = 1 / jnp.maximum(largest, jnp.finfo(G.dtype).tiny)
        self.inverse_root = (S_vectors / jnp.sqrt(jnp.where(S_values > 0, S_values, 1))) @ S_vectors.T
        a = self.inverse_root @ w
        squared = a @ a
        self.unit = a / jnp.sqrt(jnp.where(squared > 0, squared, 1))
        shift = jnp.where(self.regular, 0, 1) * jnp.eye(H * m, dtype=G.dtype)
        self.along = jax.scipy.linalg.cho_factor(G + squared * G_mean + shift, lower=True)

        def dense() -> tuple[Array, Array]:
            affine = _Affine(problem, quadratic(problem, world))
            return affine.unique, affine.inverse

        size = H * m * n
        if size <= DENSE_LIMIT:
            known = jnp.asarray(True), jnp.zeros((size, size), G.dtype)
            self.unique, inverse = jax.lax.cond(self.regular, lambda: known, dense)
            self.fallback = lambda gradient: -(inverse @ gradient.reshape(-1)).reshape(gradient.shape)
        else:
            self.unique = jnp.asarray(True)
            self.fallback = lambda gradient: _Affine(problem, quadratic(problem, world)).solve(gradient)

    def solve(self, gradient: Array) -> Array:
        return jax.lax.cond(self.regular, self._separately, self.fallback, gradient)

    def _separately(self, gradient: Array) -> Array:
        H, m, n = self.shape
        right = -gradient.reshape(H * m, n) @ self.inverse_root / 2
        mean_part = right @ self.unit
        across = right - jnp.outer(mean_part, self.unit)
        Y = self.G_vectors @ ((self.G_vectors.T @ across) / self.G_values[:, None])
        Y = Y + jnp.outer(jax.scipy.linalg.cho_solve(self.along, mean_part) - Y @ self.unit, self.unit)
        return (Y @ self.inverse_root).reshape(H, m, n)

    def minimise(self, start: Array) -> tuple[Array, Array]:
        gradient = _gradient_at(self.problem, self.world)
        M = self.solve(gradient(jnp.zeros_like(start)))
        return M + self.solve(gradient(M)), self.unique  # one step of iterative refinement

    def newton(self, M: Array) -> Operator:
        return self.solve


def _method(problem: PerformativeProblem, world: CostToGo) -> _Affine | _Projected | _Separable:
    """The cheapest method that is exact for this kind of problem; known from types and shapes alone."""
    unconstrained = isinstance(problem.feasible_set, Unconstrained)
    if unconstrained and isinstance(problem.structure, FullStructure) and _stationary(world):
        return _Separable(problem, world)
    form = quadratic(problem, world)
    return _Affine(problem, form) if problem.feasible_set.affine else _Projected(problem, form)


def respond(problem: PerformativeProblem, deployed: Array, start: Array | None = None) -> Response:
    """Φ(deployed) in the free parameters; pure, works under jit and vmap; carries no derivative."""
    world, start = jax.lax.stop_gradient(
        (cost_to_go(problem, problem.structure.lift(deployed)), deployed if start is None else start)
    )
    method = _method(problem, world)
    M, unique = method.minimise(start)
    residual = natural_residual(problem, world, deployed, method.step)
    # Pseudo-inverses turn an overflow into finite nonsense: no number at all is the honest answer.
    M = jnp.where(jnp.isfinite(residual), M, jnp.nan)
    return Response(*jax.lax.stop_gradient((M, unique, residual)))


def response_pushforward(problem: PerformativeProblem, deployed: Array, response: Array) -> Operator:
    """V -> Φ'(deployed)[V], given Φ(deployed), by the implicit function theorem."""
    world = cost_to_go(problem, problem.structure.lift(deployed))
    newton = _method(problem, world).newton(response)
    base, pushforward = jax.linearize(lambda policy: exact_gradient(problem, response, policy), deployed)
    # A Newton step is affine in the gradient to first order at a solution; its value there is zero up to rounding.
    _, step_forward = jax.linearize(newton, base)
    return lambda V: step_forward(pushforward(V))


def differentiable_response(problem: PerformativeProblem, deployed: Array) -> Array:
    """Φ(deployed) with its derivative: one Newton step on frozen matrices carries it and changes no value."""
    world = cost_to_go(problem, problem.structure.lift(deployed))
    M = respond(problem, deployed).M
    newton = _method(problem, jax.lax.stop_gradient(world)).newton(M)
    corrected = newton(_gradient_at(problem, world)(M))
    return M + (corrected - jax.lax.stop_gradient(corrected))


def residual_of(problem: PerformativeProblem, M: Array, deployed: Array) -> Array:
    """Relative natural residual; pure."""
    world = cost_to_go(problem, problem.structure.lift(deployed))
    return natural_residual(problem, world, M, _method(problem, world).step)


_compiled_respond = eqx.filter_jit(differentiable_response)
_compiled_residual = eqx.filter_jit(residual_of)


def best_response(problem: PerformativeProblem, deployed: Any) -> Array:
    """Φ(deployed) = argmin over the feasible set of C_T(·; deployed): what retraining on observed data would give.

    Exact for quadratic costs. Without constraint or mean noise it does not depend on the noise covariance, nor on
    x_0. The least-norm minimiser where there are several and the set is affine.

    Args:
        deployed: free policy parameters that the world reacts to.

    Returns:
        Shape `problem.policy_shape`.

    Raises:
        InputError: wrong shapes, or a cost or perturbation without closed moments.
    """
    deployed = problem.check_policy("deployed", deployed)
    require_moments(problem)
    return check_finite("the best response", _compiled_respond(problem, deployed))


def residual(problem: PerformativeProblem, M: Any, *, deployed: Any = None) -> Array:
    """Relative natural residual ‖M - Proj(M - ηg)‖_F / (‖M‖_F + η‖g(0)‖_F), g = ∇_1 C_T(M; deployed), η = 1/‖Hessian‖.

    Zero exactly at a best response to `deployed`; with `deployed=None` (M itself) at a performatively stable policy.
    """
    M, reacting = check_pair(problem, M, deployed)
    require_moments(problem)
    return check_finite("the residual", _compiled_residual(problem, M, reacting))
