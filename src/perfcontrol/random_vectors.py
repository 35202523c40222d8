"""Laws of random vectors: the noise w_t and the initial state x_0.

A law answers `sample(key, horizon)` with independent draws, shape (horizon, n), and knows its `mean`, its
`covariance` (both without a time axis unless the law varies in time) and its almost-sure Euclidean `bound`.
Covariance is always about the mean; second moments are never stored.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammainc
from jaxtyping import Array, Float, Key
from scipy import special

from perfcontrol._checks import as_array, check_shape, check_symmetric_psd, fail, is_concrete
from perfcontrol._linalg import psd_factor


class AbstractRandomVector(eqx.Module):
    """A law of independent random vectors of dimension n."""

    @property
    @abc.abstractmethod
    def mean(self) -> Array:
        """Mean, shape (n,), or (T, n) if it varies in time."""

    @property
    @abc.abstractmethod
    def covariance(self) -> Array:
        """Covariance about the mean, shape (n, n), or (T, n, n) if it varies in time."""

    @property
    @abc.abstractmethod
    def bound(self) -> Array | None:
        """A number that the Euclidean norm almost surely does not exceed; None if unbounded."""

    @abc.abstractmethod
    def sample(self, key: Key[Array, ""], horizon: int) -> Float[Array, "horizon n"]:
        """Independent draws for t = 0..horizon-1."""

    def resize(self, size: int) -> "AbstractRandomVector":
        """This law in dimension `size`: scalar parameters are repeated, anything else must fit already."""
        return self

    @property
    def size(self) -> int:
        """Dimension n."""
        return self.mean.shape[-1]


def random_signs(key: Key[Array, ""], shape: tuple[int, ...], dtype: Any) -> Array:
    """Independent ±1, thirty-two from each random word."""
    count = int(np.prod(shape, dtype=int))
    words = jax.random.bits(key, ((count + 31) // 32,), jnp.uint32)
    bits = (words[:, None] >> jnp.arange(32, dtype=jnp.uint32)) & 1
    return (2 * bits.reshape(-1)[:count].astype(dtype) - 1).reshape(shape)


def _paired(first_name: str, first: Any, second_name: str, second: Any) -> tuple[Array, Array]:
    """Two vectors (or scalars) broadcast against each other."""
    one, two = as_array(first_name, first), as_array(second_name, second)
    for name, value in ((first_name, one), (second_name, two)):
        if value.ndim > 1:
            raise fail(name, f"{value.shape}", "be a vector (n,) or a number", "One entry per component.")
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


class _Entrywise(AbstractRandomVector):
    """Independent entries described by two vectors; numbers stand for every component until `resize`."""

    def resize(self, size: int) -> "AbstractRandomVector":
        def grow(leaf: Array) -> Array:
            return jnp.broadcast_to(leaf, (size,)) if leaf.ndim == 0 else leaf

        return jax.tree.map(grow, self)


class Uniform(_Entrywise):
    """Independent entries, uniform on [low_i, high_i].

    Args:
        low: (n,) or a number, in the units of the state.
        high: likewise, not below `low`.

    Raises:
        InputError: shapes that do not fit, or low > high.
    """

    low: Array
    high: Array

    def __init__(self, low: Any, high: Any):
        self.low, self.high = _paired("low", low, "high", high)
        if is_concrete(self.low) and is_concrete(self.high) and np.any(np.asarray(self.low) > self.high):
            raise fail("low", f"{self.low} > {self.high}", "not exceed `high`", "Swap the two arguments.")

    @property
    def mean(self) -> Array:
        return jnp.atleast_1d((self.low + self.high) / 2)

    @property
    def covariance(self) -> Array:
        return jnp.diag(jnp.atleast_1d((self.high - self.low) ** 2 / 12))

    @property
    def bound(self) -> Array:
        return jnp.linalg.norm(jnp.atleast_1d(jnp.maximum(jnp.abs(self.low), jnp.abs(self.high))))

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        low, high = jnp.atleast_1d(self.low), jnp.atleast_1d(self.high)
        return low + (high - low) * jax.random.uniform(key, (horizon, *low.shape), low.dtype)


class Rademacher(_Entrywise):
    """Independent entries mean_i ± scale_i with probability one half each.

    Args:
        scale: (n,) or a number.
        mean: (n,) or a number.
    """

    scale: Array
    centre: Array

    def __init__(self, scale: Any, mean: Any = 0):
        self.scale, self.centre = _paired("scale", scale, "mean", mean)

    @property
    def mean(self) -> Array:
        return jnp.atleast_1d(self.centre)

    @property
    def covariance(self) -> Array:
        return jnp.diag(jnp.atleast_1d(self.scale**2))

    @property
    def bound(self) -> Array:
        return jnp.linalg.norm(jnp.atleast_1d(jnp.abs(self.centre) + jnp.abs(self.scale)))

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        scale = jnp.atleast_1d(self.scale)
        return self.mean + scale * random_signs(key, (horizon, *scale.shape), scale.dtype)


def _mean_and_covariance(mean: Any, covariance: Any) -> tuple[Array, Array]:
    centre, spread = as_array("mean", mean), as_array("covariance", covariance)
    if centre.ndim != 1:
        raise fail("mean", f"{centre.shape}", "be a vector (n,)", "One entry per component.")
    size = centre.shape[0]
    check_shape("covariance", spread, (size, size), ("n", "n"))
    check_symmetric_psd("covariance", spread, "A covariance has no negative eigenvalue.")
    dtype = jnp.result_type(centre, spread)
    return centre.astype(dtype), spread.astype(dtype)


class Gaussian(AbstractRandomVector):
    """Gaussian of given mean (n,) and covariance (n, n), which may be singular. Unbounded."""

    centre: Array
    spread: Array
    factor: Array

    def __init__(self, mean: Any, covariance: Any):
        self.centre, self.spread = _mean_and_covariance(mean, covariance)
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


class TruncatedGaussian(AbstractRandomVector):
    """Gaussian conditioned on the Mahalanobis ball (x - mean)ᵀ Σ⁻¹ (x - mean) ≤ bound².

    With n' = rank Σ the covariance of the truncated law is Σ P(χ²_{n'+2} ≤ bound²) / P(χ²_{n'} ≤ bound²).

    Args:
        mean: (n,).
        covariance: (n, n), Σ of the law *before* truncation; may be singular.
        bound: radius of the ball, in standard deviations.
    """

    centre: Array
    factor: Array  # Σ = factor factorᵀ
    shrinkage: Array  # truncated covariance = shrinkage Σ
    radius: Array
    radius_grid: Array
    probability_grid: Array
    rank: int = eqx.field(static=True)

    def __init__(self, mean: Any, covariance: Any, bound: Any):
        self.centre, spread = _mean_and_covariance(mean, covariance)
        self.radius = as_array("bound", bound)
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


class Constant(AbstractRandomVector):
    """The same vector (n,) every time."""

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


class Sequence(AbstractRandomVector):
    """A recorded disturbance, known in advance: values (T, n). For noise only."""

    values: Array

    def __init__(self, values: Any):
        self.values = as_array("values", values)
        if self.values.ndim != 2:
            raise fail("values", f"{self.values.shape}", "have shape (time, n)", "One row per time step.")

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


class Empirical(AbstractRandomVector):
    """Draws with replacement from the rows of samples (S, n)."""

    samples: Array

    def __init__(self, samples: Any):
        self.samples = as_array("samples", samples)
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

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        return self.samples[jax.random.randint(key, (horizon,), 0, self.samples.shape[0])]


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
            raise fail("matrix", f"{self.matrix.shape}", "have shape (n, k)", "One row per output component.")
        self.law = law.resize(self.matrix.shape[1])
        if self.law.size != self.matrix.shape[1]:
            raise fail(
                "matrix",
                f"{self.matrix.shape}",
                f"have {self.law.size} columns, the law's size",
                "Check the law.",
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
