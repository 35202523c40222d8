"""Affine images of another law."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, check_instance, check_shape, fail
from perfcontrol.random_vectors.base import AbstractRandomVector


class Linear(AbstractRandomVector):
    """offset + matrix @ v for v of another law.

    Args:
        law: the law of v, dimension k.
        matrix: (n, k).
        offset: (n,) or a number.
    """

    law: AbstractRandomVector
    matrix: Array
    offset: Array

    def __init__(self, law: AbstractRandomVector, matrix: Any, offset: Any = 0):
        self.matrix = as_array("matrix", matrix)
        if self.matrix.ndim != 2:
            raise fail("matrix", f"{self.matrix.shape}", "have shape (n, k)", "Pass one row per output component.")
        example = "pc.Gaussian(mean, covariance)"
        self.law = check_instance("law", law, AbstractRandomVector, example).resize(self.matrix.shape[1])
        if self.law.size != self.matrix.shape[1]:
            raise fail(
                "matrix",
                f"{self.matrix.shape}",
                f"have {self.law.size} columns, the law's size",
                f"Pass matrix of shape (d, {self.law.size}), or another law.",
            )
        offset = as_array("offset", offset)
        self.offset = jnp.broadcast_to(offset, (self.matrix.shape[0],)) if offset.ndim == 0 else offset
        check_shape("offset", self.offset, (self.matrix.shape[0],), ("n",))

    @property
    def mean(self) -> Array:
        return self.offset + self.law.mean @ self.matrix.T

    @property
    def covariance(self) -> Array:
        return self.matrix @ self.law.covariance @ self.matrix.T

    @property
    def bound(self) -> Array | None:
        inner = self.law.bound
        if inner is None:
            return None
        return jnp.linalg.norm(self.offset) + jnp.linalg.norm(self.matrix, ord=2) * inner

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        return self.offset + self.law.sample(key, horizon) @ self.matrix.T
