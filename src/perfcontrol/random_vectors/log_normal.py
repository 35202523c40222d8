"""Exponentials of Gaussian vectors: price ratios with a drift, a volatility and a correlation."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, check_symmetric_psd, fail
from perfcontrol._linalg import psd_factor
from perfcontrol.random_vectors.base import AbstractRandomVector


class LogNormal(AbstractRandomVector):
    """exp(g), entry by entry, of a Gaussian vector g ~ N(mean, covariance).

    E_i = exp(mean_i + covariance_ii / 2), covariance E_i E_j (exp(covariance_ij) - 1). Unbounded.

    Args:
        mean: (n,) or (T, n), of the logarithm: for prices the drift per day.
        covariance: (n, n) or (T, n, n), of the logarithm; may be singular.

    Raises:
        InputError: shapes that do not fit, or a covariance that is not positive semidefinite.
    """

    log_mean: Array
    log_covariance: Array
    factor: Array

    def __init__(self, mean: Any, covariance: Any):
        centre, spread = as_array("mean", mean), as_array("covariance", covariance)
        if centre.ndim not in (1, 2):
            raise fail("mean", f"{centre.shape}", "have shape (n,) or (T, n)", "Pass one entry per component.")
        n, times = (
            centre.shape[-1],
            {array.shape[0] for array, fixed in ((centre, 1), (spread, 2)) if array.ndim > fixed},
        )
        if spread.ndim not in (2, 3) or spread.shape[-2:] != (n, n):
            raise fail(
                "covariance", f"{spread.shape}", f"have shape {(n, n)} or (T, {n}, {n})", "Pass one that fits the mean."
            )
        if len(times) == 2:
            raise fail(
                "covariance",
                f"{spread.shape[0]} times",
                f"have as many as the mean, {centre.shape[0]}",
                "Give both the same times, or one of them none.",
            )
        check_symmetric_psd("covariance", spread, "A covariance has no negative eigenvalue.")
        self.log_mean = jnp.broadcast_to(centre, (*times, n))
        self.log_covariance = jnp.broadcast_to(spread, (*times, n, n))
        self.factor = psd_factor(self.log_covariance)

    @property
    def mean(self) -> Array:
        return jnp.exp(self.log_mean + jnp.diagonal(self.log_covariance, axis1=-2, axis2=-1) / 2)

    @property
    def covariance(self) -> Array:
        mean = self.mean
        return mean[..., :, None] * mean[..., None, :] * jnp.expm1(self.log_covariance)

    @property
    def bound(self) -> None:
        return None

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        normal = jax.random.normal(key, (horizon, self.log_mean.shape[-1]), self.log_mean.dtype)
        return jnp.exp(self.log_mean + jnp.einsum("...ij,...j->...i", self.factor, normal))
