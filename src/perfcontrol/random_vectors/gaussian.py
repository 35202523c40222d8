"""Gaussian vectors."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, check_shape, check_symmetric_psd, fail
from perfcontrol._linalg import psd_factor
from perfcontrol.random_vectors.base import AbstractRandomVector


class Gaussian(AbstractRandomVector):
    """Gaussian, unbounded.

    Args:
        mean: (n,).
        covariance: (n, n); may be singular.
    """

    centre: Array
    spread: Array
    factor: Array

    def __init__(self, mean: Any, covariance: Any):
        self.centre, self.spread = mean_and_covariance(mean, covariance)
        self.factor = psd_factor(self.spread)

    @property
    def mean(self) -> Array:
        return self.centre

    @property
    def covariance(self) -> Array:
        return self.spread

    @property
    def bound(self) -> None:
        return None

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        normal = jax.random.normal(key, (horizon, *self.centre.shape), self.centre.dtype)
        return self.centre + normal @ self.factor.T


def mean_and_covariance(mean: Any, covariance: Any) -> tuple[Array, Array]:
    """Mean (n,) and covariance (n, n), checked and of one precision."""
    centre, spread = as_array("mean", mean), as_array("covariance", covariance)
    if centre.ndim != 1:
        raise fail("mean", f"{centre.shape}", "be a vector (n,)", "Pass one entry per component.")
    size = centre.shape[0]
    check_shape("covariance", spread, (size, size), ("n", "n"))
    check_symmetric_psd("covariance", spread, "A covariance has no negative eigenvalue.")
    dtype = jnp.result_type(centre, spread)
    return centre.astype(dtype), spread.astype(dtype)
