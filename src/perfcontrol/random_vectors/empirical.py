"""Draws from recorded samples."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, fail
from perfcontrol.random_vectors.base import AbstractRandomVector


class Empirical(AbstractRandomVector):
    """Draws with replacement from given rows.

    Args:
        samples: (S, n), one observation a row.
    """

    samples: Array

    def __init__(self, samples: Any):
        self.samples = as_array("samples", samples, "Leave out the rows with missing values.")
        if self.samples.ndim != 2 or self.samples.shape[0] == 0:
            raise fail("samples", f"{self.samples.shape}", "have shape (sample, n)", "Pass at least one row.")

    @property
    def mean(self) -> Array:
        return jnp.mean(self.samples, axis=0)

    @property
    def covariance(self) -> Array:
        centred = self.samples - self.mean
        return centred.T @ centred / self.samples.shape[0]

    @property
    def bound(self) -> Array:
        return jnp.max(jnp.linalg.norm(self.samples, axis=-1))

    @property
    def entry_range(self) -> tuple[Array, Array]:
        return jnp.min(self.samples), jnp.max(self.samples)

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        return self.samples[jax.random.randint(key, (horizon,), 0, self.samples.shape[0])]
