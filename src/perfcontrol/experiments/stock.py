"""The paper's experiment as a problem: stock investment risk minimisation (Appendix A, Example 1).

What the paper leaves open is completed here, each with its reason:
- rate r = 0.05, trading hours h = 6.5 (a US trading day), initial investment q_1 = 150: not given; with these the
  paper's figures come out.
- growth ρ in A = ρ I: the paper prints A = I, and compares an almost surely stable, an unstable and a general
  regime without saying how they are made.
- the volatility is read as log-normal: as printed it is clipped to -0.6 on every day, and nothing depends on the
  policy.
"""

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import as_array, check_shape, fail
from perfcontrol.costs import QuadraticCost
from perfcontrol.perturbations import StockPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import AbstractRandomVector, Linear, StochasticVolatility, Uniform
from perfcontrol.sets import AbstractSet, RepeatedBlock, RowSimplex, RowSum
from perfcontrol.systems import LinearSystem

STOCKS = 10
HORIZON = 60
ORDERS = ("ascending", "descending", "random")
# Rank of each day's sensitivity in the paper's list of random order (0 is the smallest).
RANDOM_ORDER = (
    36, 16, 35, 31, 0, 52, 27, 6, 37, 42, 56, 54, 34, 13, 4, 20, 18, 39, 28, 40,
    25, 23, 19, 8, 48, 33, 49, 29, 51, 57, 17, 7, 38, 26, 47, 50, 22, 11, 10, 12,
    46, 1, 21, 53, 24, 55, 41, 14, 15, 3, 2, 45, 43, 30, 9, 32, 5, 59, 58, 44,
)  # fmt: skip


def stock_sensitivities(order: str) -> np.ndarray:
    """The paper's 60 sensitivities, sum 2.

    They are proportional to k² for k = 1..20, 4k³ for k = 21..40 and 5k³ for k = 41..60: the printed numbers to all
    nine digits.

    Examples:
        >>> [round(float(value), 6) for value in stock_sensitivities("descending")[:3]]
        [0.135861, 0.129181, 0.122723]

    Args:
        order: "ascending", "descending" or (as printed) "random".
    """
    if order not in ORDERS:
        raise fail("order", repr(order), f"be one of {ORDERS}", "Pass one of these names.")
    k = np.arange(1.0, HORIZON + 1)
    values = np.where(k <= 20, k**2, np.where(k <= 40, 4 * k**3, 5 * k**3))
    values = np.sort(2 * values / values.sum())
    return {"ascending": values, "descending": values[::-1], "random": values[list(RANDOM_ORDER)]}[order]


def stock_market(
    order: Literal["ascending", "descending", "random"] = "ascending",
    growth: Any = 1.0,
    initial_investment: Any = 150.0,
    rate: Any = 0.05,
    trading_hours: Any = 6.5,
    feasible_set: Literal["rows", "simplex"] = "rows",
    volatility: Literal["lognormal", "as_printed"] = "lognormal",
) -> PerformativeProblem:
    """Ten stocks over sixty days; the policy is the 10 x 10 block M = h/(24-h) portfolio, lifted to blockdiag(M, M).

    State [r; q]: mean-shifted return and return; cost Σ ‖r_t‖² + ‖M (w_{t-1} - E w)‖²; K = 0, B = I, memory 1.

    Args:
        order: of the sensitivities over time.
        growth: ρ in A = ρ I.
        initial_investment: q_1 of every stock.
        rate: riskless rate over the horizon.
        trading_hours: h, 0 < h < 24.
        feasible_set: "rows" (every row sums to h/(24-h), any sign: the set of the simulation) or "simplex"
            (nonnegative as well: the weights of Example 1).
        volatility: "lognormal" or "as_printed" (then nothing depends on the policy).

    Returns:
        The problem, with policy_shape (1, 10, 10).

    References:
        Appendix A, Example 1 and the simulation paragraph after it.
    """
    growth, investment = as_array("growth", growth), as_array("initial_investment", initial_investment)
    for name, value in (("growth", growth), ("initial_investment", investment)):
        check_shape(name, value, (), (), "Pass one number, the same for every stock.")
    return investment_problem(
        growth=StochasticVolatility(stock_sensitivities(order), rate, volatility, STOCKS),
        risk=Uniform(np.zeros(STOCKS), np.ones(STOCKS)),
        horizon=HORIZON,
        capital=investment,
        trading_hours=trading_hours,
        feasible_set=feasible_set,
        persistence=growth,
    )


def investment_problem(
    *,
    growth: AbstractRandomVector,
    risk: AbstractRandomVector,
    horizon: int,
    capital: Any,
    trading_hours: Any,
    feasible_set: str,
    persistence: Any = 1.0,
) -> PerformativeProblem:
    """Example 1 for any laws of the day's price ratios and of the risk w_t, of L stocks each; A = persistence I."""
    if not 0 < float(trading_hours) < 24:
        raise fail("trading_hours", str(trading_hours), "lie between 0 and 24", "Pass hours per day, such as 6.5.")
    exposure = float(trading_hours) / (24 - float(trading_hours))
    sets: dict[str, AbstractSet] = {"rows": RowSum(exposure), "simplex": RowSimplex(exposure)}
    if feasible_set not in sets:
        raise fail("feasible_set", repr(feasible_set), f"be one of {tuple(sets)}", "Pass one of these names.")
    count = risk.size
    eye, zero = np.eye(count), np.zeros((count, count))
    shown = np.block([[eye, zero], [zero, zero]])  # only the first half of state and input is paid for
    shift = np.concatenate([-np.asarray(risk.mean), np.zeros(count)])
    return PerformativeProblem(
        system=LinearSystem.diagonal(persistence * jnp.ones(2 * count), jnp.ones(2 * count)),
        horizon=horizon,
        noise=Linear(risk, np.vstack([eye, eye]), shift),
        cost=QuadraticCost(shown, shown),
        memory=1,
        perturbation=StockPerturbation(growth, exposure),
        feasible_set=sets[feasible_set],
        initial_state=jnp.concatenate([jnp.zeros(count), jnp.full(count, capital)]),
        structure=RepeatedBlock(2),
    )
