"""Linear algebra shared by several rooms: thin calls to JAX, no algorithms of our own."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from perfcontrol._programs import numerics

FUSED = 32  # columns up to which products are multiply-and-sum, which XLA fuses: faster than a library call
TERMS = 8  # of sums side by side that XLA still writes out as vectors


def along_time(array: Any, inner_ndim: int, length: int) -> Any:
    """`array` (or `Diagonal`) with a leading time axis: broadcast if constant, as it is if it has one already."""
    if array.ndim == inner_ndim:
        if isinstance(array, Diagonal):
            return Diagonal(jnp.broadcast_to(array.values, (length, *array.values.shape)))
        return jnp.broadcast_to(array, (length, *array.shape))
    return array


def transpose(matrix: Any) -> Any:
    """Transpose of the last two axes."""
    if isinstance(matrix, Diagonal):
        return matrix
    return jnp.swapaxes(matrix, -1, -2)


def frobenius(M: Any) -> Any:
    """‖M‖_F over all axes."""
    xp, _ = numerics(M)
    return xp.sqrt(xp.sum(M**2))


def solve(matrix: Any, right: Any) -> Any:
    """matrix⁻¹ right; not finite where the matrix is singular."""
    xp, _ = numerics(matrix, right)
    try:
        return xp.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:  # NumPy alone raises
        return np.full_like(right, np.nan)


def symmetrise(matrix: Array) -> Array:
    """Symmetric part over the last two axes."""
    return (matrix + transpose(matrix)) / 2


def psd_factor(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """Some L with L Lᵀ = matrix, for a positive semidefinite matrix that may be singular."""
    values, vectors = jnp.linalg.eigh(matrix)
    return vectors * jnp.sqrt(jnp.maximum(values, 0))[..., None, :]


def matvec(matrix: "Matrix", vector: Array) -> Array:
    """`matrix @ vector` as multiply-and-sum, which XLA fuses: faster than a library call for small sizes."""
    if isinstance(matrix, Diagonal):
        return matrix.values * vector
    if matrix.shape[-1] <= FUSED:
        return jnp.sum(matrix * vector[..., None, :], axis=-1)
    return jnp.einsum("...ij,...j->...i", matrix, vector)


def rmatvec(matrix: "Matrix", vector: Array) -> Array:
    """`matrix.T @ vector` as multiply-and-sum (see `matvec`)."""
    if isinstance(matrix, Diagonal):
        return matrix.values * vector
    if matrix.shape[-2] <= FUSED:
        return jnp.sum(matrix * vector[..., :, None], axis=-2)
    return jnp.einsum("...ij,...i->...j", matrix, vector)


def times(matrix: "Matrix", z: Array) -> Array:
    """`matrix @ z` in a loop over time: z (p,), or (p, paths) beside a matrix (n, p, paths) or (n, p, 1)."""
    if z.ndim == 1 or isinstance(matrix, Diagonal):
        return matvec(matrix, z)
    if _is_large(matrix) and matrix.shape[-1] == 1:
        return matrix[..., 0] @ z
    return _sum(matrix * z, 1)


def times_transposed(matrix: "Matrix", y: Array) -> Array:
    """`matrix.T @ y` in a loop over time: y (n,), or (n, paths) (see `times`)."""
    if y.ndim == 1 or isinstance(matrix, Diagonal):
        return rmatvec(matrix, y)
    if _is_large(matrix) and matrix.shape[-1] == 1:
        return matrix[..., 0].T @ y
    return _sum(matrix * y[:, None], 0)


def _sum(products: Array, axis: int) -> Array:
    """Over an axis, `TERMS` at a time."""
    parts = jnp.split(products, list(range(TERMS, products.shape[axis], TERMS)), axis)
    return sum((jnp.sum(part, axis) for part in parts[1:]), jnp.sum(parts[0], axis))


def _is_large(matrix: Array) -> bool:
    return max(matrix.shape[:2]) > FUSED


class Diagonal(eqx.Module):
    """diag(values), with any leading axes: stands for a square matrix where products should cost O(n), not O(n²)."""

    values: Array

    @property
    def ndim(self) -> int:
        """As the dense matrix."""
        return self.values.ndim + 1

    @property
    def shape(self) -> tuple[int, ...]:
        """As the dense matrix."""
        return (*self.values.shape, self.values.shape[-1])

    @property
    def T(self) -> "Diagonal":
        """Itself."""
        return self

    def dense(self) -> Array:
        """The matrix."""
        return self.values[..., None] * jnp.eye(self.values.shape[-1], dtype=self.values.dtype)

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return np.asarray(self.dense(), dtype)

    def __add__(self, other: Any) -> Any:
        if isinstance(other, Diagonal):
            return Diagonal(self.values + other.values)
        return self.dense() + other

    __radd__ = __add__

    def __matmul__(self, other: Any) -> Any:
        if isinstance(other, Diagonal):
            return Diagonal(self.values * other.values)
        return self.values[..., None] * other

    def __rmatmul__(self, other: Any) -> Any:
        return other * self.values[..., None, :]


Matrix = Array | Diagonal


def as_dense(matrix: Matrix) -> Array:
    """The matrix as an array."""
    return matrix.dense() if isinstance(matrix, Diagonal) else matrix


def congruence(F: Matrix, X: Array) -> Array:
    """Fᵀ X F."""
    return transpose(F) @ X @ F
