"""Best response on an affine set, or on none: one symmetric solve in the tangent space, least norm where singular."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._linalg import frobenius
from perfcontrol._programs import numerics, program
from perfcontrol.response.quadratic import Operator, Quadratic
from perfcontrol.sets import AbstractSet, Unconstrained


@program
def tangent_space(feasible_set: AbstractSet, like: Array) -> tuple[Array, Array]:
    """The point nearest to zero, and the orthogonal projection (p, p) onto the directions that keep the set."""
    origin = feasible_set.project(jnp.zeros_like(like))
    eye = jnp.eye(like.size, dtype=like.dtype)
    rows = jax.vmap(lambda row: feasible_set.project(row.reshape(like.shape)) - origin)(eye)
    return origin, rows.reshape(like.size, like.size)


def pseudo_inverse(matrix: Any, scale: Any) -> tuple[Any, Any]:
    """matrix⁺ of a PSD matrix, and its numerical rank; eigenvalues that are rounding beside `scale` count as zero."""
    xp, _ = numerics(matrix)
    values, vectors = xp.linalg.eigh(matrix)
    kept = values > scale * matrix.shape[0] * xp.finfo(matrix.dtype).eps
    inverse = xp.where(kept, 1 / xp.where(kept, values, 1), 0)
    return (vectors * inverse) @ vectors.T, xp.sum(kept)


class Affine:
    """The quadratic on an affine subspace, its Hessian held as a matrix."""

    def __init__(self, feasible_set: AbstractSet, form: Quadratic):
        xp, _ = numerics(form.matrix)
        matrix = form.matrix
        assert matrix is not None
        self.form, self.step = form, form.step
        if isinstance(feasible_set, Unconstrained):
            self.origin = xp.zeros(form.linear.shape, form.linear.dtype)
            self.inverse, rank = pseudo_inverse(matrix, 1 / form.step)
            self.unique = rank >= matrix.shape[0]
            return
        self.origin, P = tangent_space(feasible_set, form.linear)
        projected = P @ matrix @ P
        # By the size of the whole Hessian: on a set of one point what is left of it is rounding alone.
        inverse, rank = pseudo_inverse((projected + projected.T) / 2, 1 / form.step)
        self.inverse = P @ inverse @ P
        self.unique = rank >= xp.round(xp.trace(P))

    def solve(self, gradient: Any) -> Any:
        """The Newton step for a gradient, or for each of several along the first axis."""
        return -(gradient.reshape(-1, len(self.inverse)) @ self.inverse).reshape(gradient.shape)

    def minimise(self, start: Any) -> tuple[Any, Any]:
        """The minimiser, and whether it is the only one."""
        M = self.origin + self.solve(self.form.gradient(self.origin))
        return M + self.solve(self.form.gradient(M)), self.unique  # one step of iterative refinement

    def newton(self, M: Any) -> Operator:
        """gradient -> the Newton step from near the minimiser M."""
        return self.solve

    def jacobian(self, M: Any, reaction: Any) -> Any:
        """Φ', (p, p), given 𝐄 = ∂_2 g, (p, p)."""
        return self.solve(reaction.T).T


class AffineByProducts:
    """The same by conjugate gradients, for Hessians too large to hold; started at zero, they find the least norm."""

    def __init__(self, feasible_set: AbstractSet, form: Quadratic):
        self.form, self.step = form, form.step
        self.origin = feasible_set.project(jnp.zeros_like(form.linear))
        self.project = feasible_set.project

    def _tangent(self, V: Array) -> Array:
        largest = jax.lax.stop_gradient(jnp.max(jnp.abs(V)))
        unit = jnp.where(largest > 0, largest, 1)  # what is tiny would be lost beside the origin
        return unit * (self.project(V / unit) - self.origin)

    def solve(self, gradient: Array) -> Array:
        """The Newton step for a gradient, or for each of several along the first axis."""
        form = self.form
        if gradient.ndim > form.linear.ndim:
            return jax.lax.map(self.solve, gradient)

        def hessian(V: Array) -> Array:  # in units of its largest eigenvalue: squares would overflow
            return form.step * self._tangent(form.gradient(self._tangent(V)) - form.linear)

        tolerance = 20 * float(jnp.finfo(form.linear.dtype).eps)
        right = -form.step * self._tangent(self._tangent(gradient))
        # What rounding leaves of a gradient need not be in the range of the Hessian: never chase it.
        rounding: Any = tolerance * (frobenius(form.step * gradient) + frobenius(form.step * form.linear))
        found = jax.scipy.sparse.linalg.cg(hessian, right, tol=tolerance, atol=rounding, maxiter=10 * right.size)[0]
        return self._tangent(found)

    def minimise(self, start: Array) -> tuple[Array, Array]:
        """The minimiser; more than one is not told apart."""
        M = self.origin + self.solve(self.form.gradient(self.origin))
        return M + self.solve(self.form.gradient(M)), jnp.asarray(True)

    def newton(self, M: Array) -> Operator:
        """gradient -> the Newton step from near the minimiser M."""
        return self.solve
