"""A stock market (Appendix A, Example 1): volatile prices seen through the investor's portfolio.

State x = [r; q] of L stocks each. With the portfolio p = M[0][:L, :L] / exposure (row l spreads the return of
stock l) and the day's price ratios e, of any law, V = diag(p e) and

    Δ = [[E V - I, V - E V], [0, V - I]].

Every operator here costs O(L) or O(L²); nothing dense is built in the loops.
"""

import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, check_instance, check_shape, fail, is_concrete
from perfcontrol._linalg import Diagonal, along_time
from perfcontrol.perturbations.base import AbstractPerturbation, CovarianceOperator, Draws
from perfcontrol.random_vectors import AbstractRandomVector, fitted_vector


class StockDraws(Draws):
    """Draws of Δ by the diagonals of V - E V and E V - I."""

    deviation: Array  # (T, L): V - E V
    mean_diagonal: Array  # (T, L): E V - 1
    side_by_side: ClassVar[bool] = True

    @property
    def steps(self) -> Any:
        return self.deviation, self.mean_diagonal

    def matvec_step(self, step: Any, z: Array) -> Array:
        deviation, mean = step
        count = len(deviation)
        shared = deviation * z[count:]
        return jnp.concatenate([mean * z[:count] + shared, mean * z[count:] + shared])

    def rmatvec_step(self, step: Any, y: Array) -> Array:
        deviation, mean = step
        count = len(deviation)
        return jnp.concatenate([mean * y[:count], mean * y[count:] + deviation * (y[:count] + y[count:])])

    def dense(self) -> Array:
        def one(deviation: Array, mean: Array) -> Array:
            noise = jnp.diag(deviation)
            return jnp.block([[jnp.diag(mean), noise], [jnp.zeros_like(noise), jnp.diag(mean + deviation)]])

        return jax.vmap(one)(self.deviation, self.mean_diagonal)


class StockCovariance(CovarianceOperator):
    """What the diagonal covariances of V do to [r; q]."""

    spread: Array  # (T, L, L): of V's diagonal, portfolio Cov(e) portfolioᵀ

    @property
    def steps(self) -> Any:
        return self.spread

    def apply_step(self, step: Any, X: Array) -> Array:
        count = step.shape[-1]
        return jnp.tile(step * X[count:, count:], (2, 2))

    def adjoint_step(self, step: Any, X: Array) -> Array:
        count = step.shape[-1]
        total = X[:count, :count] + X[:count, count:] + X[count:, :count] + X[count:, count:]
        return jnp.pad(step * total, ((count, 0), (count, 0)))


class StockPerturbation(AbstractPerturbation):
    """Policy-dependent returns of a stock market.

    Args:
        growth: the law of the day's price ratios e_t, one entry a stock: `pc.LogNormal` for drifts, volatilities and
            correlations, constant or varying in time, `pc.Empirical` for recorded days, `pc.StochasticVolatility` for
            the paper's.
        exposure: h/(24-h), the factor between the policy block and the portfolio.

    Raises:
        InputError: no random vector; a law for another number of stocks or of days.

    References:
        Appendix A, equations (Example 1-A) and (Example 1-V(M)).
    """

    growth: AbstractRandomVector
    exposure: Array

    def __init__(self, growth: AbstractRandomVector, exposure: Any):
        self.growth = check_instance("growth", growth, AbstractRandomVector, "pc.LogNormal(mean, covariance)")
        self.exposure = as_array("exposure", exposure)
        check_shape("exposure", self.exposure, (), (), "Pass one number.")

    def resize(self, policy_shape: tuple[int, int, int], horizon: int) -> "StockPerturbation":
        _, m, n = policy_shape
        if m != n or n % 2:
            raise fail(
                "perturbation",
                f"m, n = {m}, {n}",
                "have m = n = 2L",
                "Use a system whose state is [r; q] of L stocks, as pc.experiments.stock_market builds it.",
            )
        return StockPerturbation(fitted_vector("growth", self.growth, n // 2, horizon), self.exposure)

    def portfolio(self, M: Array) -> Array:
        """The portfolio (L, L) behind a lifted policy."""
        count = M.shape[-1] // 2
        return M[0, :count, :count] / self.exposure

    def _mean_growth(self, M: Array, horizon: int) -> Array:
        return along_time(self.growth.mean, 1, horizon) @ self.portfolio(M).T

    def sample(self, key: Key[Array, ""], M: Array, horizon: int) -> Draws:
        deviation = (self.growth.sample(key, horizon) - self.growth.mean).astype(M.dtype) @ self.portfolio(M).T
        return StockDraws(deviation, self._mean_growth(M, horizon) - 1)

    def mean(self, M: Array, horizon: int) -> Array:
        return self.mean_operator(M, horizon).dense()

    def mean_operator(self, M: Array, horizon: int) -> Diagonal:
        return Diagonal(jnp.tile(self._mean_growth(M, horizon) - 1, (1, 2)))

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        portfolio = self.portfolio(M)
        return StockCovariance(along_time(portfolio @ self.growth.covariance @ portfolio.T, 2, horizon))

    def bound(self, feasible_set: Any, horizon: int) -> Array | None:
        """Known on a bounded set: per stock the 2 x 2 block has Frobenius norm √(a² + b² + (a+b)²)."""
        if feasible_set.radius is None or self.growth.entry_range is None:
            return None
        lowest, highest = self.growth.entry_range
        # ‖row of the portfolio‖₁ is known on the simplex; elsewhere at most √L times the radius over the exposure
        if _fixes_rows(feasible_set) and feasible_set.nonnegative:
            weight = feasible_set.row_total / self.exposure
            value_low, value_high = weight * lowest, weight * highest
        else:
            count = feasible_set.policy_size // 2
            weight = math.sqrt(count) * feasible_set.radius / self.exposure
            value_high = weight * jnp.maximum(jnp.abs(lowest), jnp.abs(highest))
            value_low = -value_high
        largest = jnp.maximum(jnp.abs(value_high - 1), jnp.abs(value_low - 1))
        return jnp.broadcast_to(jnp.max(jnp.sqrt(2 * largest**2 + (value_high - value_low) ** 2)), (horizon,))

    def sensitivity(self, feasible_set: Any, horizon: int) -> Array:
        """√(2 λ_max(Cov e + E e E eᵀ)) / exposure, on the directions that keep row sums where the set fixes them."""
        mean, spread = self.growth.mean, self.growth.covariance
        if _fixes_rows(feasible_set):
            mean = mean - jnp.mean(mean, axis=-1, keepdims=True)
            centre = jnp.eye(mean.shape[-1], dtype=mean.dtype) - 1 / mean.shape[-1]
            spread = centre @ spread @ centre
        spread = spread + mean[..., :, None] * mean[..., None, :]
        largest = jnp.maximum(jnp.linalg.eigvalsh(spread)[..., -1], 0)
        return jnp.broadcast_to(jnp.sqrt(2 * largest) / self.exposure, (horizon,))

    def policy_free_mean(self, feasible_set: Any) -> bool:
        """Whether the set fixes the row sums of the portfolio, and all stocks are known to grow alike in the mean."""
        mean = self.growth.mean
        alike = is_concrete(mean) and bool(np.all(np.asarray(mean) == np.asarray(mean)[..., :1]))
        return _fixes_rows(feasible_set) and alike


def _fixes_rows(feasible_set: Any) -> bool:
    """Whether the set fixes the row sums of the portfolio: those of the free parameters, if these are its block."""
    return feasible_set.row_total is not None and feasible_set.free_columns == feasible_set.policy_size // 2
