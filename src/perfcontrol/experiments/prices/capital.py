"""Capital as an axis: returns are proportional to it, the risk is not, so that the reaction grows with it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from perfcontrol.experiments.prices.allocations import ALLOCATIONS, allocations, weights
from perfcontrol.experiments.prices.market import market


class CapitalSweep(NamedTuple):
    """The five allocations at every capital.

    capital: (C,). costs: (C, 5), each in the world that it makes itself; nan where there is no such policy. portfolio:
    (C, 5, L), weights averaged over accounts. rate: (C,), of the best response at the stable policy. residual: (C,).
    """

    capital: np.ndarray
    costs: np.ndarray
    portfolio: np.ndarray
    rate: np.ndarray
    residual: np.ndarray


def capital_sweep(
    prices: np.ndarray, capitals: Any, progress: Callable[[float], None] | None = None, **settings: Any
) -> CapitalSweep:
    """`allocations` of the market of these prices at each capital; settings are those of `market`."""
    capitals = np.sort(np.asarray(capitals, dtype=float))
    rows: list[tuple[Any, ...]] = []
    near = None
    for index, capital in enumerate(capitals):
        problem = market(prices, capital=float(capital), **settings)
        found = allocations(problem, near=near)
        near = found.policies["optimal"]
        costs = [found.costs[name] for name in ALLOCATIONS]
        portfolio = [weights(problem, found.policies[name]).mean(axis=0) for name in ALLOCATIONS]
        rows.append((costs, portfolio, found.rate, found.residual))
        if progress is not None:
            progress((index + 1) / len(capitals))
    return CapitalSweep(capitals, *(np.array(column) for column in zip(*rows, strict=True)))
