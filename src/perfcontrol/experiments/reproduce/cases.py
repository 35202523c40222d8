"""The nine cases of the paper's experiment, three regimes by three orders, and where runs start."""

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray

from perfcontrol.config import REGIMES, ReproduceSettings
from perfcontrol.experiments.stock import ORDERS, STOCKS, stock_market
from perfcontrol.problem import PerformativeProblem

UNSTABLE = list(REGIMES).index("unstable") * len(ORDERS)  # its first case
CASES = {"regime": list(REGIMES), "order": list(ORDERS)}

Progress = Callable[[str, float], None]


def silent(stage: str, share: float) -> None:
    """No progress shown."""


def starts_of(settings: ReproduceSettings, problem: PerformativeProblem, count: int) -> np.ndarray:
    """Random portfolios (count, 1, L, L), one a seed: nonnegative rows of the required sum."""
    total = problem.feasible_set.row_total
    assert total is not None
    raw = np.random.default_rng([settings.seed, 1]).uniform(size=(count, 1, STOCKS, STOCKS))
    return raw / raw.sum(axis=-1, keepdims=True) * float(total)


def problems_of(
    settings: ReproduceSettings, feasible_set: str, volatility: str = "lognormal"
) -> list[PerformativeProblem]:
    """All cases, regime by regime, the three orders within."""
    return [
        stock_market(
            order,  # type: ignore[arg-type]
            growth=growth,
            initial_investment=settings.initial_investment,
            rate=settings.rate,
            trading_hours=settings.trading_hours,
            feasible_set=feasible_set,  # type: ignore[arg-type]
            volatility=volatility,  # type: ignore[arg-type]
        )
        for growth in REGIMES.values()
        for order in ORDERS
    ]


def by_case(rows: dict[str, list[Any]]) -> xarray.Dataset:
    """One value a case, matrices included, by regime and order."""
    cases, arrays = ("regime", "order"), {name: np.asarray(values) for name, values in rows.items()}
    data = {
        name: (
            (*cases, "row", "column")[: array.ndim + 1],
            array.reshape(len(REGIMES), len(ORDERS), *array.shape[1:]),
        )
        for name, array in arrays.items()
    }
    return xarray.Dataset(data, coords=CASES)
