"""Daily price ratios under the paper's random volatility (Appendix A, Example 1): independent stocks, all alike."""

import itertools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, check_integer, check_shape, fail, is_concrete
from perfcontrol.random_vectors.base import AbstractRandomVector

SPREAD = 0.2  # standard deviation of the Gaussian behind the volatility
LIMIT = 0.6  # the volatility is projected to [-LIMIT, LIMIT]
VOLATILITIES = ("lognormal", "as_printed")


def _volatility(normal: Any, log_sensitivity: Any, kind: str, xp: Any) -> Any:
    """v from a standard normal: clip(exp(N(log ε, 0.2²))), or clip(N(log ε, 0.2²)) as printed."""
    gaussian = log_sensitivity + SPREAD * normal
    return xp.clip(xp.exp(gaussian) if kind == "lognormal" else gaussian, -LIMIT, LIMIT)


def _growth(volatility: Any, rate: Any, horizon: int, xp: Any) -> Any:
    """exp((rate - v²/2)/T + v/√T): the day's price ratio."""
    return xp.exp((rate - volatility**2 / 2) / horizon + volatility / math.sqrt(horizon))


def price_ratios(unit: Array, log_sensitivity: Array, rate: Any, horizon: int, kind: str) -> Array:
    """The ratios that `StochasticVolatility` makes of numbers uniform on [0, 1)."""
    # As jax.random.normal: uniform on (-1, 1), which -1 itself does not belong to.
    above = np.nextafter(unit.dtype.type(-1), unit.dtype.type(0))
    normal = math.sqrt(2) * jax.lax.erf_inv(jnp.maximum(unit * (1 - above) + above, above))
    return _growth(_volatility(normal, log_sensitivity, kind, jnp), rate, horizon, jnp)


def growth_moments(log_sensitivity: np.ndarray, rate: float, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """E e and Var e for each time, by Gauss-Legendre quadrature between the kinks of the clip.

    About the growth at the centre, so that little cancels; what lies beyond nine standard deviations is put there.
    """
    horizon = len(log_sensitivity)
    nodes, weights = np.polynomial.legendre.leggauss(80)
    first, variance = np.zeros(horizon), np.zeros(horizon)
    for t, centre in enumerate(log_sensitivity):
        ends = (-np.inf, math.log(LIMIT)) if kind == "lognormal" else (-LIMIT, LIMIT)
        kinks = [float(np.clip((end - centre) / SPREAD, -9.0, 9.0)) for end in ends]
        edges = np.unique([-9.0, *kinks, 9.0])
        centre_growth = _growth(_volatility(0.0, centre, kind, np), rate, horizon, np)
        mean, square = 0.0, 0.0
        for low, high in itertools.pairwise(edges):
            normal = (low + high) / 2 + (high - low) / 2 * nodes
            density = np.exp(-(normal**2) / 2) / math.sqrt(2 * math.pi) * weights * (high - low) / 2
            growth = _growth(_volatility(normal, centre, kind, np), rate, horizon, np) - centre_growth
            mean, square = mean + density @ growth, square + density @ growth**2
        first[t], variance[t] = centre_growth + mean, square - mean**2
    return first, variance


class StochasticVolatility(AbstractRandomVector):
    """Daily price ratios exp((rate - v²/2)/T + v/√T) of stocks whose volatilities v are drawn anew each day.

    Args:
        sensitivities: (T,), positive: the paper's ε_t, which set the volatility of day t.
        rate: riskless interest rate over the T days.
        volatility: "lognormal" (v = clip(exp N(log ε, 0.2²))) or "as_printed" (v = clip(N(log ε, 0.2²)),
            which is -0.6 almost surely for the paper's ε), clipped to [-0.6, 0.6].
        stocks: how many; None for as many as are asked for.

    References:
        Appendix A, equation (Example 1-V(M)).
    """

    sensitivities: Array
    log_sensitivity: Array
    rate: Array
    first_moment: Array
    variance: Array  # held apart from the moments: in float32 their difference would be mostly rounding
    alike: Array | None  # ones (L,), once the number of stocks is known
    volatility: str = eqx.field(static=True)

    def __init__(self, sensitivities: Any, rate: Any, volatility: str = "lognormal", stocks: int | None = None):
        self.sensitivities = sensitivities = as_array("sensitivities", sensitivities)
        if sensitivities.ndim != 1 or (is_concrete(sensitivities) and np.any(np.asarray(sensitivities) <= 0)):
            raise fail("sensitivities", f"{sensitivities.shape}", "be positive numbers (T,)", "Pass one per day.")
        if volatility not in VOLATILITIES:
            raise fail("volatility", repr(volatility), f"be one of {VOLATILITIES}", "Pass one of these names.")
        self.rate = as_array("rate", rate)
        check_shape("rate", self.rate, (), (), "Pass one number.")
        self.log_sensitivity = jnp.log(sensitivities)
        self.volatility = volatility
        self.alike = None if stocks is None else jnp.ones(check_integer("stocks", stocks, 1), sensitivities.dtype)
        first, variance = growth_moments(np.log(np.asarray(sensitivities, dtype=float)), float(self.rate), volatility)
        self.first_moment = jnp.asarray(first, sensitivities.dtype)
        self.variance = jnp.asarray(variance, sensitivities.dtype)

    def resize(self, size: int) -> "StochasticVolatility":
        if self.alike is not None:
            return self
        ones = jnp.ones(size, self.variance.dtype)
        return eqx.tree_at(lambda law: law.alike, self, ones, is_leaf=lambda leaf: leaf is None)

    @property
    def _ones(self) -> Array:
        return jnp.ones(1, self.variance.dtype) if self.alike is None else self.alike

    @property
    def mean(self) -> Array:
        return self.first_moment[:, None] * self._ones

    @property
    def covariance(self) -> Array:
        return self.variance[:, None, None] * jnp.diag(self._ones)

    @property
    def bound(self) -> Array:
        return jnp.linalg.norm(self._ones) * self.entry_range[1]

    @property
    def entry_range(self) -> tuple[Array, Array]:
        """It grows with v up to v = √T, beyond the clip for T ≥ 1."""
        low = 0.0 if self.volatility == "lognormal" else -LIMIT
        horizon = self.log_sensitivity.shape[0]
        return _growth(low, self.rate, horizon, jnp), _growth(LIMIT, self.rate, horizon, jnp)

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        def of_stock(unit: Array) -> Array:
            return price_ratios(unit, self.log_sensitivity, self.rate, len(self.log_sensitivity), self.volatility)

        # Stock by stock, since XLA would otherwise work day by day on vectors of a few stocks, which takes over twice
        # as long.
        unit = jax.random.uniform(key, (horizon, *self._ones.shape), self.log_sensitivity.dtype)
        return jax.lax.map(of_stock, unit.T).T
