"""The stock market of the paper (Appendix A, Example 1): volatile prices seen through the investor's portfolio.

State x = [r; q] of L stocks each. With the portfolio p = M[0][:L, :L] / exposure (row l spreads the return of
stock l) and e_i = exp((rate - v_i²/2)/T + v_i/√T) for the volatility v_i, V = diag(p e) and

    Δ = [[E V - I, V - E V], [0, V - I]].

Every operator here costs O(L) or O(L²); nothing dense is built in the loops.
"""

import itertools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key
from scipy import special

from perfcontrol._checks import as_array, check_shape, fail, is_concrete
from perfcontrol._linalg import Diagonal
from perfcontrol.perturbations.base import AbstractPerturbation, CovarianceOperator, Draws

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


def growth_moments(log_sensitivity: np.ndarray, rate: float, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """E e and E e² for each time, by Gauss-Legendre quadrature between the kinks of the clip."""
    horizon = len(log_sensitivity)
    nodes, weights = np.polynomial.legendre.leggauss(80)
    first, second = np.zeros(horizon), np.zeros(horizon)
    for t, centre in enumerate(log_sensitivity):
        ends = (-np.inf, math.log(LIMIT)) if kind == "lognormal" else (-LIMIT, LIMIT)
        kinks = [float(np.clip((end - centre) / SPREAD, -9.0, 9.0)) for end in ends]
        edges = np.unique([-9.0, *kinks, 9.0])
        for low, high in itertools.pairwise(edges):
            normal = (low + high) / 2 + (high - low) / 2 * nodes
            density = np.exp(-(normal**2) / 2) / math.sqrt(2 * math.pi) * weights * (high - low) / 2
            growth = _growth(_volatility(normal, centre, kind, np), rate, horizon, np)
            first[t] += density @ growth
            second[t] += density @ growth**2
        tails = 2 * special.ndtr(-9.0)  # what lies beyond nine standard deviations, put at the centre
        centre_growth = _growth(_volatility(0.0, centre, kind, np), rate, horizon, np)
        first[t] += tails * centre_growth
        second[t] += tails * centre_growth**2
    return first, second


class _StockDraws(Draws):
    deviation: Array  # (T, L): V - E V
    mean_diagonal: Array  # (T, L): E V - 1

    @property
    def steps(self) -> Any:
        return self.deviation, self.mean_diagonal

    def matvec_step(self, step: Any, z: Array) -> Array:
        deviation, mean = step
        count = deviation.shape[-1]
        shared = deviation * z[count:]
        return jnp.concatenate([mean * z[:count] + shared, mean * z[count:] + shared])

    def rmatvec_step(self, step: Any, y: Array) -> Array:
        deviation, mean = step
        count = deviation.shape[-1]
        return jnp.concatenate([mean * y[:count], mean * y[count:] + deviation * (y[:count] + y[count:])])

    def dense(self) -> Array:
        def one(deviation: Array, mean: Array) -> Array:
            noise = jnp.diag(deviation)
            return jnp.block([[jnp.diag(mean), noise], [jnp.zeros_like(noise), jnp.diag(mean + deviation)]])

        return jax.vmap(one)(self.deviation, self.mean_diagonal)


class _StockCovariance(CovarianceOperator):
    variance: Array  # (T,): of e
    gram: Array  # (L, L): portfolio portfolioᵀ

    @property
    def steps(self) -> Any:
        return self.variance

    def apply_step(self, step: Any, X: Array) -> Array:
        count = self.gram.shape[-1]
        block = step * self.gram * X[count:, count:]
        return jnp.tile(block, (2, 2))

    def adjoint_step(self, step: Any, X: Array) -> Array:
        count = self.gram.shape[-1]
        total = X[:count, :count] + X[:count, count:] + X[count:, :count] + X[count:, count:]
        return jnp.pad(step * self.gram * total, ((count, 0), (count, 0)))


class StockPerturbation(AbstractPerturbation):
    """Policy-dependent returns of the paper's stock market.

    Args:
        sensitivities: (T,), positive: the paper's ε_t, which set the volatility of day t.
        rate: riskless interest rate over the horizon.
        exposure: h/(24-h), the factor between the policy block and the portfolio.
        volatility: "lognormal" (v = clip(exp N(log ε, 0.2²))) or "as_printed" (v = clip(N(log ε, 0.2²)),
            which is -0.6 almost surely, so that nothing depends on the policy).

    References:
        Appendix A, equations (Example 1-A) and (Example 1-V(M)).
    """

    log_sensitivity: Array
    rate: Array
    exposure: Array
    first_moment: Array
    variance: Array  # held apart from the moments: in float32 their difference would be mostly rounding
    volatility: str = eqx.field(static=True)

    def __init__(self, sensitivities: Any, rate: Any, exposure: Any, volatility: str = "lognormal"):
        sensitivities = as_array("sensitivities", sensitivities)
        if sensitivities.ndim != 1 or (is_concrete(sensitivities) and np.any(np.asarray(sensitivities) <= 0)):
            raise fail("sensitivities", f"{sensitivities.shape}", "be positive numbers (T,)", "One per day.")
        if volatility not in VOLATILITIES:
            raise fail("volatility", repr(volatility), f"be one of {VOLATILITIES}", "Pass one of these names.")
        self.rate, self.exposure = as_array("rate", rate), as_array("exposure", exposure)
        for name, value in (("rate", self.rate), ("exposure", self.exposure)):
            check_shape(name, value, (), (), "Pass one number.")
        self.log_sensitivity = jnp.log(sensitivities)
        self.volatility = volatility
        first, second = growth_moments(np.log(np.asarray(sensitivities, dtype=float)), float(self.rate), volatility)
        self.first_moment = jnp.asarray(first, sensitivities.dtype)
        self.variance = jnp.asarray(second - first**2, sensitivities.dtype)

    def check(self, policy_shape: tuple[int, int, int], horizon: int) -> None:
        _, m, n = policy_shape
        if m != n or n % 2:
            raise fail("perturbation", f"m, n = {m}, {n}", "have m = n = 2L", "The state is [r; q] of L stocks.")
        check_shape("sensitivities", self.log_sensitivity, (horizon,), ("horizon",), "Give one sensitivity per day.")

    def portfolio(self, M: Array) -> Array:
        """The portfolio (L, L) behind a lifted policy."""
        count = M.shape[-1] // 2
        return M[0, :count, :count] / self.exposure

    def _mean_growth(self, M: Array) -> Array:
        return self.first_moment[:, None] * jnp.sum(self.portfolio(M), axis=-1)

    def sample(self, key: Key[Array, ""], M: Array, horizon: int) -> Draws:
        portfolio = self.portfolio(M)
        normal = jax.random.normal(key, (horizon, portfolio.shape[-1]), M.dtype)
        volatility = _volatility(normal, self.log_sensitivity[:, None], self.volatility, jnp)
        growth = _growth(volatility, self.rate, self.log_sensitivity.shape[0], jnp)
        deviation = (growth - self.first_moment[:, None]) @ portfolio.T
        return _StockDraws(deviation, self._mean_growth(M) - 1)

    def mean(self, M: Array, horizon: int) -> Array:
        return self.mean_operator(M, horizon).dense()

    def mean_operator(self, M: Array, horizon: int) -> Diagonal:
        return Diagonal(jnp.tile(self._mean_growth(M) - 1, (1, 2)))

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        portfolio = self.portfolio(M)
        return _StockCovariance(self.variance, portfolio @ portfolio.T)

    def bound(self, feasible_set: Any, horizon: int) -> Array | None:
        """Known on a bounded set: per stock the 2 x 2 block has Frobenius norm √(a² + b² + (a+b)²)."""
        if feasible_set.radius is None:
            return None
        lowest, highest = self._growth_range(horizon)
        # ‖row of the portfolio‖₁ is known on the simplex; elsewhere at most √L times the radius over the exposure
        if self.policy_free_mean(feasible_set) and feasible_set.nonnegative:
            weight = feasible_set.row_total / self.exposure
            value_low, value_high = weight * lowest, weight * highest
        else:
            count = feasible_set.policy_size // 2
            weight = math.sqrt(count) * feasible_set.radius / self.exposure
            value_low, value_high = -weight * highest, weight * highest
        largest = jnp.maximum(jnp.abs(value_high - 1), jnp.abs(value_low - 1))
        return jnp.broadcast_to(jnp.max(jnp.sqrt(2 * largest**2 + (value_high - value_low) ** 2)), (horizon,))

    def sensitivity(self, feasible_set: Any, horizon: int) -> Array:
        """√(2 Var e) / exposure where the set fixes the row sums, else with L (E e)² added under the root."""
        variance = self.variance
        if not self.policy_free_mean(feasible_set):
            variance = variance + feasible_set.policy_size / 2 * self.first_moment**2
        return jnp.sqrt(2 * variance) / self.exposure

    def policy_free_mean(self, feasible_set: Any) -> bool:
        """Whether the set fixes the row sums of the portfolio: those of the free parameters, if these are its block."""
        return feasible_set.row_total is not None and feasible_set.free_columns == feasible_set.policy_size // 2

    def _growth_range(self, horizon: int) -> tuple[Array, Array]:
        """The almost-sure range of e; it grows with v up to v = √T, beyond the clip for T ≥ 1."""
        low = 0.0 if self.volatility == "lognormal" else -LIMIT
        return _growth(low, self.rate, horizon, jnp), _growth(LIMIT, self.rate, horizon, jnp)
