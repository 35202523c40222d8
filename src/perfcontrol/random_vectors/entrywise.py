"""Laws of independent entries, described by two vectors or numbers."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import as_array, fail
from perfcontrol.random_vectors.base import AbstractRandomVector


class Entrywise(AbstractRandomVector):
    """Independent entries described by two vectors; numbers stand for every component until `resize`."""

    def resize(self, size: int) -> "AbstractRandomVector":
        def grow(leaf: Array) -> Array:
            return jnp.broadcast_to(leaf, (size,)) if leaf.ndim == 0 else leaf

        return jax.tree.map(grow, self)


def paired(first_name: str, first: Any, second_name: str, second: Any) -> tuple[Array, Array]:
    """Two vectors (or scalars) broadcast against each other."""
    one, two = as_array(first_name, first), as_array(second_name, second)
    for name, value in ((first_name, one), (second_name, two)):
        if value.ndim > 1:
            raise fail(name, f"{value.shape}", "be a vector (n,) or a number", "Pass one entry per component.")
    try:
        shape = jnp.broadcast_shapes(one.shape, two.shape)
    except ValueError as error:
        raise fail(
            second_name,
            f"{two.shape}",
            f"fit `{first_name}` of shape {one.shape}",
            "Give both the same length.",
        ) from error
    dtype = jnp.result_type(one, two)
    return jnp.broadcast_to(one, shape).astype(dtype), jnp.broadcast_to(two, shape).astype(dtype)
