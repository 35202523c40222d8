"""Policies whose rows have a given sum, with and without a sign constraint."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import as_array, check_nonnegative, fail
from perfcontrol.sets.base import AbstractSet


class _Rows(AbstractSet):
    """Every row of every lag sums to `total`: a number, or (memory, input) with one number a row."""

    total: Array

    @property
    def row_total(self) -> Array:
        return self.total

    def check(self, shape: tuple[int, ...]) -> None:
        if self.total.ndim and self.total.shape != shape[:-1]:
            raise fail(
                "total",
                f"{self.total.shape}",
                f"be a number or have shape (memory, input) = {shape[:-1]}",
                "Pass one sum per row of each lag of the free parameters.",
            )


class RowSum(_Rows):
    """{M : Σ_j M[i, r, j] = total for every lag i and row r}: an affine set.

    Args:
        total: a number or (memory, input).
    """

    def __init__(self, total: Any):
        self.total = as_array("total", total)

    def project(self, M: Array) -> Array:
        excess = jnp.sum(M, axis=-1) - self.total
        return M - (excess / M.shape[-1])[..., None]

    def support(self, direction: Array) -> None:
        return None

    @property
    def affine(self) -> bool:
        return True


class RowSimplex(_Rows):
    """{M ≥ 0 : Σ_j M[i, r, j] = total for every lag i and row r}.

    Args:
        total: a nonnegative number or (memory, input).

    Raises:
        InputError: a negative total (the set is empty).
    """

    def __init__(self, total: Any):
        self.total = as_array("total", total)
        remedy = "Nonnegative entries cannot have a negative sum."
        check_nonnegative("total", self.total, remedy, ": the set is empty")

    def project(self, M: Array) -> Array:
        """Shift every row by the one threshold that makes its positive part sum to `total`."""
        descending = -jnp.sort(-M, axis=-1)
        excess = jnp.cumsum(descending, axis=-1) - self.total[..., None]
        counts = jnp.arange(1, M.shape[-1] + 1, dtype=M.dtype)
        positive = descending * counts > excess
        kept = jnp.maximum(jnp.sum(positive, axis=-1, keepdims=True), 1)
        threshold = jnp.take_along_axis(excess, kept - 1, axis=-1) / kept
        return jnp.maximum(M - threshold, 0)

    def support(self, direction: Array) -> Array:
        return jnp.sum(self.total * jnp.max(direction, axis=-1), axis=(-2, -1))

    def farthest(self, center: Array) -> Array:
        """At the vertex that puts the whole of each row where the center is least."""
        vertex = jnp.argmin(center, axis=-1, keepdims=True) == jnp.arange(center.shape[-1])
        return jnp.linalg.norm((self.total[..., None] * vertex - center).reshape(-1))

    def radius(self, shape: tuple[int, ...]) -> Array:
        return self.farthest(jnp.zeros(shape, self.total.dtype))

    @property
    def nonnegative(self) -> bool:
        return True
