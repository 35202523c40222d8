"""No randomness: one vector."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, fail
from perfcontrol.random_vectors.base import AbstractRandomVector


class Constant(AbstractRandomVector):
    """The same vector every time.

    Args:
        value: (n,) or a number.
    """

    value: Array

    def __init__(self, value: Any):
        self.value = as_array("value", value)
        if self.value.ndim > 1:
            raise fail("value", f"{self.value.shape}", "be a vector (n,)", "Use Sequence for one vector per time.")

    def resize(self, size: int) -> "AbstractRandomVector":
        return Constant(jnp.broadcast_to(self.value, (size,))) if self.value.ndim == 0 else self

    @property
    def mean(self) -> Array:
        return jnp.atleast_1d(self.value)

    @property
    def covariance(self) -> Array:
        return jnp.zeros((self.size, self.size), self.value.dtype)

    @property
    def bound(self) -> Array:
        return jnp.linalg.norm(self.mean)

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        return jnp.broadcast_to(self.mean, (horizon, self.size))
