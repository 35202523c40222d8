"""Gaussian vectors cut at an ellipsoid."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammainc
from jaxtyping import Array, Key
from scipy import special

from perfcontrol._checks import as_array, check_shape, fail, is_concrete
from perfcontrol.random_vectors.base import AbstractRandomVector
from perfcontrol.random_vectors.gaussian import mean_and_covariance


class TruncatedGaussian(AbstractRandomVector):
    """Gaussian conditioned on the Mahalanobis ball (x - mean)ᵀ Σ⁻¹ (x - mean) ≤ bound².

    With n' = rank Σ the covariance of the truncated law is Σ P(χ²_{n'+2} ≤ bound²) / P(χ²_{n'} ≤ bound²).

    Args:
        mean: (n,).
        covariance: (n, n), Σ of the law *before* truncation; may be singular.
        bound: radius of the ball, in standard deviations.
    """

    centre: Array
    spread: Array  # Σ
    factor: Array  # Σ = factor factorᵀ
    shrinkage: Array  # truncated covariance = shrinkage Σ
    radius: Array
    radius_grid: Array
    probability_grid: Array
    rank: int = eqx.field(static=True)

    def __init__(self, mean: Any, covariance: Any, bound: Any):
        self.centre, self.spread = mean_and_covariance(mean, covariance)
        spread = self.spread
        self.radius = as_array("bound", bound, "Without truncation it is pc.Gaussian(mean, covariance).")
        check_shape("bound", self.radius, (), (), "Pass one number, in standard deviations.")
        if not is_concrete(self.radius) or not is_concrete(spread):
            raise fail("bound", "a traced value", "be known when the law is built", "Build the law outside jit.")
        if float(self.radius) <= 0:
            raise fail("bound", f"{float(self.radius)}", "be positive", "Pass a radius in standard deviations.")
        values, vectors = np.linalg.eigh(np.asarray(spread, dtype=float))
        kept = values > max(values.max(initial=0.0), 0.0) * len(values) * float(jnp.finfo(spread.dtype).eps)
        self.rank = max(int(kept.sum()), 1)
        basis = np.zeros((len(values), self.rank))
        basis[:, : kept.sum()] = vectors[:, kept] * np.sqrt(values[kept])
        self.factor = jnp.asarray(basis, spread.dtype)
        half, limit = self.rank / 2, float(self.radius) ** 2 / 2
        mass = special.gammainc(half, limit)
        self.shrinkage = jnp.asarray(special.gammainc(half + 1, limit) / mass, spread.dtype)
        radii = np.linspace(0.0, float(self.radius), 513)
        self.radius_grid = jnp.asarray(radii, spread.dtype)
        self.probability_grid = jnp.asarray(special.gammainc(half, radii**2 / 2) / mass, spread.dtype)

    @property
    def mean(self) -> Array:
        return self.centre

    @property
    def covariance(self) -> Array:
        return self.shrinkage * self.factor @ self.factor.T

    @property
    def bound(self) -> Array:
        # ‖mean‖ + radius √λ_max(Σ): attained if the mean lies along the leading eigenvector, else an upper bound.
        return jnp.linalg.norm(self.centre) + self.radius * jnp.linalg.norm(self.factor, ord=2)

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        direction_key, radius_key = jax.random.split(key)
        dtype = self.centre.dtype
        normal = jax.random.normal(direction_key, (horizon, self.rank), dtype)
        direction = normal / jnp.linalg.norm(normal, axis=-1, keepdims=True)
        radius = self._radius(jax.random.uniform(radius_key, (horizon,), dtype))
        return self.centre + (radius[:, None] * direction) @ self.factor.T

    def _radius(self, probability: Array) -> Array:
        """Inverse of the radius' distribution function: a table, then three Newton steps kept inside their cell."""
        half = self.rank / 2
        mass = gammainc(half, self.radius**2 / 2)
        cell = jnp.clip(jnp.searchsorted(self.probability_grid, probability, side="right"), 1, 512)
        low, high = self.radius_grid[cell - 1], self.radius_grid[cell]
        p_low, p_high = self.probability_grid[cell - 1], self.probability_grid[cell]
        radius = low + (high - low) * (probability - p_low) / jnp.maximum(p_high - p_low, jnp.finfo(low.dtype).tiny)
        log_constant = jnp.log(mass) + jax.scipy.special.gammaln(half) + (half - 1) * jnp.log(2.0)
        for _ in range(3):
            error = gammainc(half, radius**2 / 2) / mass - probability
            density = jnp.exp((self.rank - 1) * jnp.log(jnp.maximum(radius, 1e-30)) - radius**2 / 2 - log_constant)
            radius = jnp.clip(radius - error / jnp.maximum(density, 1e-30), low, high)
        return radius
