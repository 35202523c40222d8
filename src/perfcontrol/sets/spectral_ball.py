"""Policies whose stacked matrix has bounded singular values."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._checks import as_radius
from perfcontrol._linalg import transpose
from perfcontrol.sets.base import AbstractSet


@jax.custom_jvp
def clip_singular_values(X: Float[Array, "r c"], limit: Float[Array, ""]) -> Float[Array, "r c"]:
    """U min(S, limit) Vᵀ for X = U S Vᵀ: the nearest matrix of spectral norm at most `limit`."""
    U, values, Vt = jnp.linalg.svd(X, full_matrices=False)
    return jnp.where(values[0] <= limit, X, (U * jnp.minimum(values, limit)) @ Vt)


@clip_singular_values.defjvp
def _clip_derivative(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    """By divided differences of the clip, which stay in [0, 1] where singular values meet; that of the SVD does not.

    With Z = Uᵀ dX V: the symmetric part of Z is weighted by (f_i - f_j)/(s_i - s_j), the skew part by
    (f_i + f_j)/(s_i + s_j), and what lies outside the column or row space by f_i / s_i.
    """
    X, limit = primals
    dX, dlimit = tangents
    wide = X.shape[0] <= X.shape[1]
    tall_X, tall_dX = (transpose(X), transpose(dX)) if wide else (X, dX)
    U, s, Vt = jnp.linalg.svd(tall_X, full_matrices=False)  # (c, r), (r,), (r, r): V is square
    f = jnp.minimum(s, limit)

    def ratio(above: Array, below: Array, at_zero: Array) -> Array:
        return jnp.where(below > 0, above / jnp.where(below > 0, below, 1), at_zero)

    low, high = jnp.minimum(s[:, None], s[None, :]), jnp.maximum(s[:, None], s[None, :])
    inside = (high <= limit).astype(s.dtype)
    # Both values above the limit: 0; both below: 1; one on either side: in between.
    difference = jnp.where((low < limit) & (high > limit), ratio(limit - low, high - low, inside), inside)
    mean = ratio(f[:, None] + f[None, :], s[:, None] + s[None, :], jnp.ones_like(low))
    inner = U.T @ tall_dX @ Vt.T
    symmetric, skew = (inner + inner.T) / 2, (inner - inner.T) / 2
    outer = tall_dX @ Vt.T - U @ inner
    moved = U @ (difference * symmetric + mean * skew) + outer * ratio(f, s, jnp.ones_like(s))
    derivative = (moved + U * jnp.where(s > limit, dlimit, 0)) @ Vt
    value = (U * f) @ Vt
    value, derivative = (transpose(value), transpose(derivative)) if wide else (value, derivative)
    return jnp.where(s[0] <= limit, X, value), derivative


class SpectralBall(AbstractSet):
    """{M : ‖[M[0], ..., M[H-1]]‖₂ ≤ radius}: the lags side by side as one (m, H n) matrix.

    Its norm bounds the input: ‖Σ_i M[i-1] w_{t-i}‖ ≤ radius √H max_i ‖w_{t-i}‖. Under a structure the matrix is that of
    the free parameters; repeated blocks have the same norm as the full policy.

    Args:
        radius: a nonnegative number.

    Raises:
        InputError: a negative radius (the set is empty).
    """

    limit: Array

    def __init__(self, radius: Any):
        self.limit = as_radius(radius)

    def project(self, M: Array) -> Array:
        """Singular values of the stacked matrix above the radius are set to it."""
        H, m, n = M.shape
        clipped = clip_singular_values(_stacked(M), self.limit.astype(M.dtype))
        return clipped.reshape(m, H, n).transpose(1, 0, 2)

    def support(self, direction: Array) -> Array:
        """The radius times the nuclear norm of the stacked direction."""
        return self.limit * jnp.sum(jnp.linalg.svd(_stacked(direction), compute_uv=False), axis=-1)

    def farthest(self, center: Array) -> Array:
        """At -radius U Vᵀ for the stacked center U S Vᵀ: largest in norm, and the most against the center."""
        return jnp.linalg.norm(self.limit + jnp.linalg.svd(_stacked(center), compute_uv=False))

    def radius(self, shape: tuple[int, ...]) -> Array:
        H, m, n = shape
        return self.limit * jnp.sqrt(jnp.asarray(min(m, H * n), self.limit.dtype))


def _stacked(M: Array) -> Array:
    """The lags side by side, (..., m, H n)."""
    H, m, n = M.shape[-3:]
    return jnp.swapaxes(M, -3, -2).reshape(*M.shape[:-3], m, H * n)
