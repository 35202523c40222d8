"""The stock market of one's own prices: the paper's model (Appendix A, Example 1) with every law estimated.

What the model asks for, and where it comes from:
- growth e_t, the day's price ratios: log-normal, with the drift, volatility and correlation of the recorded days, in
  money discounted at the riskless rate;
- risk w_t: profit and loss, while the market is closed, of a standing position of 100 in each stock: the recorded days
  themselves, drawn with replacement;
- capital, the money that the policy allocates. Risk does not depend on it, returns are proportional to it: the larger
  it is, the more of the state is the reaction.
Both come from the same days, which the model takes to be independent of each other and over time.
"""

import math
from typing import Any, Literal, NamedTuple

import numpy as np

from perfcontrol._checks import as_array, check_integer, check_shape, fail
from perfcontrol.experiments.prices.cleaning import check_prices
from perfcontrol.experiments.stock import investment_problem
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import Empirical, LogNormal

POSITION = 100.0  # the standing position whose profit and loss is the risk w_t
YEAR = 252  # trading days


class Days(NamedTuple):
    """Recorded days in the model's terms: growth (days, L) in discounted money, risk (days, L)."""

    growth: np.ndarray
    risk: np.ndarray


def recorded_days(prices: np.ndarray, rate: Any, trading_hours: Any) -> Days:
    """The days between consecutive rows of clean prices (days + 1, L)."""
    growth = prices[1:] / prices[:-1] * math.exp(-rate / YEAR)
    return Days(growth, POSITION * (24 - trading_hours) / 24 * (growth - 1))


def market(
    prices: Any,
    horizon: int = 60,
    capital: Any = 150.0,
    rate: Any = 0.05,
    trading_hours: Any = 6.5,
    feasible_set: Literal["rows", "simplex"] = "rows",
    splits: Literal["refuse", "adjust", "keep"] = "refuse",
) -> PerformativeProblem:
    """The paper's stock market with the laws of daily growth and risk estimated from prices.

    State [r; q] of L stocks: mean-shifted return and return; the policy is the L x L block M = h/(24-h) portfolio.

    Args:
        prices: (days, stocks), daily closing prices, oldest first, adjusted for splits and dividends.
        horizon: T, trading days over which costs are summed.
        capital: money in each stock's account at the start, where the risk is that of a standing position of 100.
        rate: riskless interest a year, at which money is discounted.
        trading_hours: h, 0 < h < 24: the policy meets the risk of the h hours in which the market is open.
        feasible_set: "rows" (every row of the portfolio sums to one, any sign) or "simplex" (no short positions).
        splits: what to do where a price jumps as by a split that it is not adjusted for: "refuse", "adjust" the
            earlier prices, or "keep" the jump as a loss or gain.

    Returns:
        The problem, with policy_shape (1, L, L).

    Raises:
        InputError: prices that are missing, not positive, too few, the same for two stocks, or jump as by a split;
            other arguments out of range.
    """
    capital, rate = (check_number(name, value) for name, value in (("capital", capital), ("rate", rate)))
    if capital <= 0:
        raise fail(
            "capital",
            f"{capital:g}",
            "be positive",
            "Pass for example capital=150.0, of which the policy allocates; the risk is that of 100.",
        )
    values = check_prices(prices, splits=splits)
    days = recorded_days(values, rate, check_number("trading_hours", trading_hours))
    logarithms = np.log(days.growth)
    return investment_problem(
        growth=LogNormal(logarithms.mean(axis=0), np.cov(logarithms, rowvar=False)),
        risk=Empirical(days.risk),
        horizon=check_integer("horizon", horizon, 2),
        capital=capital,
        trading_hours=trading_hours,
        feasible_set=feasible_set,
    )


def check_number(name: str, value: Any) -> float:
    """One finite number."""
    array = as_array(name, value)
    check_shape(name, array, (), (), "Pass one number.")
    return float(array)
