"""What allocations cost in days that they were not estimated from, in windows that roll over the record."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import check_integer, fail
from perfcontrol._programs import program
from perfcontrol.evaluate.rollout import run_path
from perfcontrol.experiments.prices.allocations import ALLOCATIONS, Allocations, allocations, weights
from perfcontrol.experiments.prices.market import Days, market, recorded_days
from perfcontrol.perturbations.stock import StockDraws
from perfcontrol.problem import PerformativeProblem

Progress = Callable[[float], None]


class Windows(NamedTuple):
    """Costs of the five allocations in every window.

    first, last: (W,), rows of the prices between which a window is judged. predicted, realised: (W, 5), what the model
    expects and what the recorded days made of it; nan where there is no such policy. portfolio: (W, 5, L), weights
    averaged over accounts. residual: (W,), of the optimal policy. rate: (W,), at the stable one.
    """

    first: np.ndarray
    last: np.ndarray
    predicted: np.ndarray
    realised: np.ndarray
    portfolio: np.ndarray
    residual: np.ndarray
    rate: np.ndarray


@program
def _realised(problem: PerformativeProblem, M: Array, growth: Array, noise: Array) -> Array:
    law: Any = problem.perturbation
    policy = problem.structure.lift(M)
    portfolio = law.portfolio(policy)
    expected = jnp.broadcast_to(law.growth.mean, growth.shape) @ portfolio.T
    draws = StockDraws((growth - law.growth.mean) @ portfolio.T, expected - 1)
    path = run_path(problem, policy, problem.initial_state.mean, noise, draws)
    return jnp.sum(problem.cost.path_cost(path.x, path.u))


def realised_cost(problem: PerformativeProblem, M: np.ndarray, days: Days) -> float:
    """The cost of a policy along recorded days, as many as the horizon; what it expects is what the problem expects."""
    if not np.all(np.isfinite(M)):
        return np.nan
    shift = np.asarray(problem.noise.mean)[: days.risk.shape[1]] - problem.noise.law.mean  # type: ignore[union-attr]
    return float(_realised(problem, jnp.asarray(M), days.growth, np.hstack([days.risk + shift, days.risk])))


def rolling_windows(
    prices: np.ndarray,
    *,
    horizon: int = 60,
    window: int = 504,
    count: int | None = 12,
    rate: Any = 0.05,
    trading_hours: Any = 6.5,
    progress: Progress | None = None,
    **settings: Any,
) -> Windows:
    """Estimate on `window` days, judge on the `horizon` days after them; then move on by `horizon` days.

    Args:
        prices: (days, L), clean.
        horizon: days of each judgement.
        window: days before it that the laws are estimated from.
        count: the most recent so many windows; None for all that there are.
        rate, trading_hours, settings: of `market`.
        progress: called with the share that is done.
    """
    most = (len(prices) - 1 - check_integer("window", window, 2)) // horizon
    if most < 1:
        needed = f"cover {window} + {horizon} days for one window to be judged out of sample"
        raise fail("prices", f"{len(prices) - 1} days", needed, "Pass more days, or a smaller window.")
    wanted = most if count is None else min(most, check_integer("count", count, 1))
    first = len(prices) - 1 - horizon * np.arange(wanted, 0, -1)
    rows: list[tuple[Any, ...]] = []
    near = None
    for index, row in enumerate(first):
        known = prices[row - window : row + 1]
        problem = market(known, horizon, rate=rate, trading_hours=trading_hours, **settings)
        found: Allocations = allocations(problem, near=near)
        near = found.policies["optimal"]
        days = recorded_days(prices[row : row + horizon + 1], rate, trading_hours)
        rows.append(
            (
                [found.costs[name] for name in ALLOCATIONS],
                [realised_cost(problem, found.policies[name], days) for name in ALLOCATIONS],
                [weights(problem, found.policies[name]).mean(axis=0) for name in ALLOCATIONS],
                found.residual,
                found.rate,
            )
        )
        if progress is not None:
            progress((index + 1) / wanted)
    return Windows(first, first + horizon, *(np.array(column) for column in zip(*rows, strict=True)))
