"""Recorded disturbances."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, fail
from perfcontrol.random_vectors.base import AbstractRandomVector


class Sequence(AbstractRandomVector):
    """A recorded disturbance, known in advance. For noise only.

    Args:
        values: (T, n), one vector a time step.
    """

    values: Array

    def __init__(self, values: Any):
        self.values = as_array("values", values)
        if self.values.ndim != 2:
            raise fail("values", f"{self.values.shape}", "have shape (time, n)", "Pass one row per time step.")

    @property
    def mean(self) -> Array:
        return self.values

    @property
    def covariance(self) -> Array:
        horizon, size = self.values.shape
        return jnp.zeros((horizon, size, size), self.values.dtype)

    @property
    def bound(self) -> Array:
        return jnp.max(jnp.linalg.norm(self.values, axis=-1))

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        return self.values[:horizon]
