"""Figures of a market: what each allocation holds, what it costs out of sample, and what the capital changes."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.dates
import matplotlib.pyplot as plt
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes

from perfcontrol.plotting.style import save_figure, styled

if TYPE_CHECKING:
    from perfcontrol.experiments.prices.study import Study

# In the order of `ALLOCATIONS`: colour, marker, line. The naive one is hollow: the stable one often lies inside it.
_LOOKS: Any = (
    ({"color": "#7F7F7F", "marker": "s", "ms": 3.4}, (0, (1, 1))),
    ({"color": "#56B4E9", "marker": "D", "ms": 3.4}, (0, (4, 1.5))),
    ({"color": "#E69F00", "marker": "v", "ms": 5.5, "mfc": "none", "mew": 1.2}, (0, (3, 1, 1, 1))),
    ({"color": "#C0392B", "marker": "o", "ms": 3.4}, "-"),
    ({"color": "#0072B2", "marker": "^", "ms": 3.6}, "-"),
)


def figure_allocations(study: "Study", path: Path) -> list[Path]:
    """What each allocation holds now: a row a stock.

    Args:
        study: of `perfcontrol.experiments.prices.study`.
        path: without suffix; PNG and SVG are written.
    """
    stocks, names = study.table.stocks, list(study.now.policies)
    with styled():
        figure, axes = plt.subplots(figsize=(4.6, 1.0 + 0.24 * len(stocks)), layout="constrained")
        rows = np.arange(len(stocks))
        for index, name in enumerate(names):
            style, _ = _LOOKS[index]
            offset = 0.11 * (index - 2)
            weights = study.portfolio(name)
            axes.hlines(rows + offset, 0, weights, color=style["color"], linewidth=0.8)
            axes.plot(weights, rows + offset, linestyle="none", label=name, **style | {"ms": 3.4})
        axes.axvline(0, color="#444444", linewidth=0.6)
        axes.set_yticks(rows, stocks)
        axes.set_ylim(len(stocks) - 0.5, -0.5)
        axes.grid(False, axis="y")
        axes.set_xlabel("weight, averaged over accounts")
        axes.set_title(f"Allocations on {study.table.dates[-1]}")
        figure.legend(loc="outside lower center", ncols=3)
        return save_figure(figure, path)


def figure_windows(study: "Study", path: Path) -> list[Path]:
    """Realised costs of every window: against equal weight over time, and against what was expected.

    Args:
        study: of `perfcontrol.experiments.prices.study`.
        path: without suffix; PNG and SVG are written.
    """
    windows, dates = study.windows, [study.table.dates[row] for row in study.windows.last]
    with styled():
        figure, (over_time, calibration) = plt.subplots(
            1, 2, figsize=(7.2, 2.9), width_ratios=(1.5, 1), layout="constrained"
        )
        for index, name in enumerate(study.now.policies):
            style, line = _LOOKS[index]
            realised, expected = windows.realised[:, index], windows.predicted[:, index]
            over_time.plot(
                matplotlib.dates.date2num(dates), realised / windows.realised[:, 0], linestyle=line, label=name, **style
            )
            calibration.plot(expected, realised, linestyle="none", **style)
        over_time.set_yscale("log")
        _plain_ticks(over_time)
        locator = matplotlib.dates.AutoDateLocator(maxticks=7)
        over_time.xaxis.set_major_locator(locator)
        over_time.xaxis.set_major_formatter(matplotlib.dates.ConciseDateFormatter(locator))
        over_time.set_xlabel("last day of the window")
        over_time.set_ylabel("realised cost / that of equal weight")
        over_time.set_title(f"(a) out of sample, {len(dates)} windows of {study.settings['horizon']} days", loc="left")
        calibration.set_xscale("log")
        calibration.set_yscale("log")
        calibration.axline((1.0, 1.0), (10.0, 10.0), color="#444444", linewidth=0.8, zorder=0)
        for limits, costs in ((calibration.set_xlim, windows.predicted), (calibration.set_ylim, windows.realised)):
            known = costs[np.isfinite(costs)]
            limits(known.min() / 1.5, known.max() * 1.5)
        calibration.set_xlabel("expected cost")
        calibration.set_ylabel("realised cost")
        calibration.set_title("(b) against what was expected", loc="left")
        figure.legend(*over_time.get_legend_handles_labels(), loc="outside lower center", ncols=5)
        return save_figure(figure, path)


def figure_capital(study: "Study", path: Path) -> list[Path]:
    """What capital changes: excess costs, the strength of the reaction, and how far allocations are from least risk.

    Args:
        study: with a sweep.
        path: without suffix; PNG and SVG are written.
    """
    sweep = study.sweep
    assert sweep is not None
    with styled():
        figure, (costs, rate, share) = plt.subplots(1, 3, figsize=(7.6, 2.7), layout="constrained")
        least = sweep.costs[:, -1]
        for index, name in enumerate(study.now.policies):
            style, line = _LOOKS[index]
            ratio = sweep.costs[:, index] / least
            costs.plot(sweep.capital, np.where(np.isfinite(ratio), ratio, np.nan), linestyle=line, label=name, **style)
            distance = np.abs(sweep.portfolio[:, index] - sweep.portfolio[:, 1]).sum(axis=1) / 2
            share.plot(sweep.capital, distance, linestyle=line, **style)
        costs.set_yscale("log")
        _plain_ticks(costs)
        costs.set_ylabel("cost / that of the optimal allocation")
        costs.set_title("(a) price of not foreseeing", loc="left")
        rate.plot(sweep.capital, sweep.rate, **_LOOKS[3][0])
        rate.axhline(1, color="#444444", linewidth=0.8, linestyle="--")
        rate.set_yscale("log")
        rate.set_ylabel(r"spectral radius of $\Phi'$")
        rate.set_title("(b) strength of the reaction", loc="left")
        share.set_ylabel("distance from minimum variance")
        share.set_title("(c) allocations", loc="left")
        for axes in (costs, rate, share):
            axes.set_xscale("log")
            axes.set_xlabel("capital of an account")
            axes.set_xlim(costs.get_xlim())
        _mark_absence(rate, sweep.capital, np.isnan(sweep.rate))
        figure.legend(*costs.get_legend_handles_labels(), loc="outside lower center", ncols=5)
        return save_figure(figure, path)


def _mark_absence(axes: Axes, capital: np.ndarray, absent: np.ndarray) -> None:
    """Shade the capitals at the upper end for which no stable policy was found."""
    if absent[-1] and not absent.all():
        first = len(absent) - int(np.argmin(absent[::-1]))
        start, end = float(np.sqrt(capital[first - 1] * capital[first])), axes.get_xlim()[1]
        axes.axvspan(start, end, color="#EEEEEE", zorder=0)
        middle = float(np.sqrt(start * end))
        axes.text(middle, 0.06, "none\nfound", transform=axes.get_xaxis_transform(), ha="center", fontsize=8)


def _plain_ticks(axes: Axes) -> None:
    """Numbers such as 0.5 and 2 on a logarithmic axis that spans little, powers of ten elsewhere."""
    low, high = axes.get_ylim()
    if high / low < 50:
        subs = (1.0, 1.2, 1.5, 2.0, 3.0, 5.0) if high / low < 5 else (1.0, 2.0, 5.0)
        axes.yaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=subs))
        axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axes.yaxis.set_minor_locator(matplotlib.ticker.NullLocator())
