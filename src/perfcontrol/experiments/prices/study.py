"""All that `perfcontrol stocks` says about one table of prices, as one object and as plain data."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from perfcontrol.experiments.prices.allocations import ALLOCATIONS, Allocations, allocations, weights
from perfcontrol.experiments.prices.capital import CapitalSweep, capital_sweep
from perfcontrol.experiments.prices.market import market
from perfcontrol.experiments.prices.table import PriceTable
from perfcontrol.experiments.prices.windows import Windows, rolling_windows
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory import Certificate, Sharp, certify

Progress = Callable[[str, float], None]
CAPITALS = 10.0 ** np.arange(-1.5, 1.25, 0.5)  # of the sweep, relative to the capital that was asked for


@dataclass(frozen=True)
class Study:
    """The market of the last `window` days, its allocations and certificate; windows out of sample; the sweep."""

    table: PriceTable
    settings: dict[str, Any]
    problem: PerformativeProblem
    now: Allocations
    certificate: Certificate | None
    windows: Windows
    sweep: CapitalSweep | None

    def portfolio(self, name: str) -> np.ndarray:
        """Weights to hold now, (L,), averaged over accounts; nan where there is no such policy."""
        return weights(self.problem, self.now.policies[name]).mean(axis=0)

    def data(self) -> dict[str, Any]:
        """Everything as plain data for JSON; None where a number is not known."""
        windows, sweep = self.windows, self.sweep
        return {
            "stocks": list(self.table.stocks),
            "days": len(self.table.dates),
            "first_day": self.table.dates[0].isoformat(),
            "last_day": self.table.dates[-1].isoformat(),
            "notes": list(self.table.notes),
            "settings": self.settings,
            "allocations": {
                name: {"weights": plain(self.portfolio(name)), "expected_cost": plain(self.now.costs[name])}
                for name in ALLOCATIONS
            },
            "portfolios": {name: plain(weights(self.problem, self.now.policies[name])) for name in ALLOCATIONS},
            "certificate": None if self.certificate is None else str(self.certificate),
            "rate": plain(self.now.rate),
            "residual": plain(self.now.residual),
            "out_of_sample": self.summary(),
            "windows": [
                {
                    "first_day": self.table.dates[windows.first[i] + 1].isoformat(),
                    "last_day": self.table.dates[windows.last[i]].isoformat(),
                    "expected": dict(zip(ALLOCATIONS, plain(windows.predicted[i]), strict=True)),
                    "realised": dict(zip(ALLOCATIONS, plain(windows.realised[i]), strict=True)),
                    "rate": plain(windows.rate[i]),
                }
                for i in range(len(windows.first))
            ],
            "capital_sweep": None
            if sweep is None
            else [
                {
                    "capital": plain(sweep.capital[i]),
                    "costs": dict(zip(ALLOCATIONS, plain(sweep.costs[i]), strict=True)),
                    "rate": plain(sweep.rate[i]),
                }
                for i in range(len(sweep.capital))
            ],
        }

    def summary(self) -> dict[str, dict[str, Any]]:
        """Realised costs by allocation: mean, median, and against equal weight in the same window."""
        realised, predicted = self.windows.realised, self.windows.predicted
        rows = {}
        for index, name in enumerate(ALLOCATIONS):
            known = np.isfinite(realised[:, index])
            cost, ratio = realised[known, index], realised[known, index] / realised[known, 0]
            rows[name] = {
                "windows": int(known.sum()),
                "mean": plain(cost.mean()) if known.any() else None,
                "median": plain(np.median(cost)) if known.any() else None,
                "ratio": plain(np.exp(np.mean(np.log(ratio)))) if known.any() else None,
                "cheaper": int(np.sum(ratio < 1)),
                "realised_over_expected": plain(np.median(cost / predicted[known, index])) if known.any() else None,
            }
        return rows


def plain(value: Any) -> Any:
    """Numbers and arrays as Python numbers and lists, None for what is not finite."""
    array = np.asarray(value)
    if array.ndim:
        return [plain(entry) for entry in array]
    return float(array) if np.isfinite(array) else None


def study(
    table: PriceTable,
    *,
    horizon: int = 60,
    window: int | None = None,
    windows: int | None = 12,
    capital: Any = 150.0,
    rate: Any = 0.05,
    trading_hours: Any = 6.5,
    feasible_set: str = "rows",
    sweep: bool = True,
    progress: Progress = lambda stage, share: None,
) -> Study:
    """Estimate on the last `window` days (None: two years, or half of the record) and judge on rolling windows.

    Raises:
        InputError: as `market`; too few days for one window.
    """
    prices = table.prices
    window = min(504, (len(prices) - 1) // 2) if window is None else window
    shared: dict[str, Any] = {"rate": rate, "trading_hours": trading_hours, "feasible_set": feasible_set}
    shared["splits"] = "keep"  # the table was checked when it was read
    rolled = rolling_windows(
        prices,
        horizon=horizon,
        window=window,
        count=windows,
        capital=capital,
        progress=lambda share: progress("rolling windows", share),
        **shared,
    )
    recent = prices[-window - 1 :]
    problem = market(recent, horizon, capital, **shared)
    now = allocations(problem, starts=4)
    certificate = None
    if np.all(np.isfinite(now.policies["stable"])):
        certificate = certify(problem, Sharp(M=now.policies["stable"], samples=0))
    progress("now", 1.0)
    swept = None
    if sweep:
        capitals = capital * CAPITALS
        swept = capital_sweep(recent, capitals, lambda share: progress("capital", share), horizon=horizon, **shared)
    settings = {"horizon": horizon, "window": window, "capital": capital, **shared}
    del settings["splits"]
    return Study(table, settings, problem, now, certificate, rolled, swept)
