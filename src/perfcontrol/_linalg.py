"""Linear algebra shared by several rooms: thin calls to JAX, no algorithms of our own."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def along_time(array: Array, inner_ndim: int, length: int) -> Array:
    """`array` with a leading time axis: broadcast if constant, as it is if it has one already."""
    if array.ndim == inner_ndim:
        return jnp.broadcast_to(array, (length, *array.shape))
    return array


def transpose(matrix: Array) -> Array:
    """Transpose of the last two axes."""
    return jnp.swapaxes(matrix, -1, -2)


def symmetrise(matrix: Array) -> Array:
    """Symmetric part over the last two axes."""
    return (matrix + transpose(matrix)) / 2


def psd_factor(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """Some L with L Lᵀ = matrix, for a positive semidefinite matrix that may be singular."""
    values, vectors = jnp.linalg.eigh(matrix)
    return vectors * jnp.sqrt(jnp.maximum(values, 0))[..., None, :]


def matvec(matrix: Array, vector: Array) -> Array:
    """`matrix @ vector` as multiply-and-sum, which XLA fuses: faster than a library call for small sizes."""
    if matrix.shape[-1] <= 32:
        return jnp.sum(matrix * vector[..., None, :], axis=-1)
    return jnp.einsum("...ij,...j->...i", matrix, vector)


def rmatvec(matrix: Array, vector: Array) -> Array:
    """`matrix.T @ vector` as multiply-and-sum (see `matvec`)."""
    if matrix.shape[-2] <= 32:
        return jnp.sum(matrix * vector[..., :, None], axis=-2)
    return jnp.einsum("...ij,...i->...j", matrix, vector)
