"""The exact cost stock by stock, for hundreds of thousands of policies.

Stocks are alike and independent, and nothing couples them but the policy. Stock l has the state [r; q] and adds to it
the row m of M times the noise of the day before; V sees the deployed row m' by its sum and its norm alone. So

    C_T(M; M') = Σ_l c_l,    c_l = k_0 + k_1 m_l + k_2 ‖m‖²,

with coefficients k that depend on the sums of m and m', here the same, and on ‖m'‖². They come from the cost-to-go
λ_t r² + μ_t q² + 2 b_t q, with φ_t = ρ - 1 + E e_t Σ m'/exposure the mean of what r and q are multiplied by, and
Var e_t ‖m'‖²/exposure² the variance of what carries q over into both:

    λ_t = 1 + φ_t² λ_{t+1},    μ_t = φ_t² μ_{t+1} + Var e_t ‖m'‖²/exposure² (λ_{t+1} + μ_{t+1}),
    b_t = φ_t (μ_{t+1} E d_t + b_{t+1}),    E d_t = (1 + Σ m) E w for t > 0, E w at t = 0.

A noise of variance σ² reaches [r; q] at once through the identity and a day later through m: a day costs
σ² (λ_{t+1} + μ_{t+1}) (1 + ‖m‖² + 2 φ_t m_l) + μ_{t+1} (E d_t)² + 2 b_{t+1} E d_t, and σ² ‖m‖² for the input; without
the terms in m at t = 0.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._programs import program
from perfcontrol.problem import PerformativeProblem

TOGETHER = 1024  # rows worked on together: they stay in cache
CEILING = 1e30  # costs of runaway policies are astronomical: recorded as this


def row_form(problem: PerformativeProblem, total: Any, square: Any) -> tuple[Any, Any, Any]:
    """k_0, k_1 and k_2 of a market of `stock_market`, for deployed rows of sum `total` and squared norm `square`."""
    growth, noise = problem.perturbation.growth, problem.noise.law  # type: ignore[attr-defined]
    stocks = noise.size
    market = (
        problem.system.A.values[0],  # type: ignore[union-attr]
        growth.first_moment,
        growth.variance,
        problem.perturbation.exposure,  # type: ignore[attr-defined]
        problem.initial_state.mean[stocks],
        noise.mean[0],
        noise.covariance[0, 0],
    )
    total, square = np.broadcast_arrays(total, square)
    size = math.ceil(square.size / TOGETHER) * TOGETHER
    rows = [np.resize(np.asarray(part, float).reshape(-1), size).reshape(-1, TOGETHER) for part in (total, square)]
    return tuple(part.reshape(-1)[: square.size].reshape(square.shape) for part in _form(market, *rows))


@program
def _form(market: Any, total: Any, square: Any) -> Any:
    rho, first, variance, exposure, capital, mean, spread = market

    def of_rows(rows: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        reaction, square = rows[0] / exposure, rows[1] / exposure**2
        drift, zero = mean * (1 + rows[0]), jnp.zeros_like(square)

        def retreat(carry: Any, day: Any) -> tuple[Any, None]:
            of_r, of_q, linear, constant, by_own, by_square = carry
            first_t, variance_t = day
            phi, both, pushed = rho - 1 + first_t * reaction, of_r + of_q, of_q * drift
            following = (
                1 + phi**2 * of_r,
                phi**2 * of_q + variance_t * square * both,
                phi * (pushed + linear),
                constant + drift * (pushed + 2 * linear),
                by_own + phi * both,
                by_square + both,
            )
            return following, None

        (of_r, of_q, linear, constant, by_own, by_square), _ = jax.lax.scan(
            retreat, (zero + 1, *[zero] * 5), (first[1:], variance[1:]), reverse=True
        )
        # The first day, on which nothing has been seen that could be answered.
        phi, both = rho - 1 + first[0] * reaction, of_r + of_q
        constant += mean * (of_q * mean + 2 * linear) + spread * (by_square + both)
        of_q, linear = phi**2 * of_q + variance[0] * square * both, phi * (of_q * mean + linear)
        constant += of_q * capital**2 + 2 * linear * capital
        return constant, 2 * spread * by_own, spread * (len(first) + by_square)

    return jax.lax.map(of_rows, (total, square))


def costs(problem: PerformativeProblem, policies: np.ndarray) -> np.ndarray:
    """Exact C_T(M; M) of policies (..., 1, L, L); `CEILING` where it is larger or overflows."""
    rows = policies[..., 0, :, :].astype(float)
    total, square = rows @ np.ones(rows.shape[-1]), np.einsum("...ij,...ij->...i", rows, rows)
    own = np.diagonal(rows, axis1=-2, axis2=-1)
    constant, by_own, by_square = row_form(problem, total, square)
    with np.errstate(invalid="ignore", over="ignore"):
        cost = np.sum(constant + by_own * own + by_square * square, axis=-1)
        return np.where(cost < CEILING, cost, CEILING)  # False for what is not finite
