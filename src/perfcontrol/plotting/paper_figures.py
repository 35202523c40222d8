"""The figures of the paper's numerical section, and the one it lacks."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import xarray
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from perfcontrol.config import ReproduceSettings
from perfcontrol.plotting.style import ORDER_COLOURS, ORDER_MARKS, REGIME_TITLES, band, save_figure, styled
from perfcontrol.reports.paper.divergence import share_that_left

OPTIMUM: Any = {"linestyle": (0, (6, 2, 1, 2)), "linewidth": 0.9}
CEILING = 1e4  # of the error axis, relative to the first error: beyond it a run has left for good


def draw_runs(out: Path, runs: xarray.Dataset, optimum: xarray.Dataset) -> list[Path]:
    """Figures 1 and 2 as PNG and SVG."""
    with styled():
        return figure_error(runs, out / "figure1_error") + figure_cost(runs, optimum, out / "figure2_cost")


def draw_cure(out: Path, cure: xarray.Dataset, sweep: xarray.Dataset, settings: ReproduceSettings) -> list[Path]:
    """Figure 3 as PNG and SVG."""
    with styled():
        return figure_cure(cure, sweep, settings, out / "figure3_cure")


def _quantiles(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """10 %, median, 90 % over seeds (first axis)."""
    low, middle, high = np.percentile(values, [10, 50, 90], axis=0)
    return low, middle, high


def _log_axes(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_minor_formatter(NullFormatter())


def _guide(axes: Axes, start: float, end: float, level: float) -> None:
    """A 1/n line that ends at `level`."""
    axes.plot([start, end], [level * end / start, level], color="#555555", linestyle=(0, (4, 3)), linewidth=1)
    axes.annotate(
        r"$1/n$",
        (np.sqrt(start * end), level * np.sqrt(end / start)),
        xytext=(-3, -3),
        textcoords="offset points",
        ha="right",
        va="top",
        color="#555555",
    )


def _orders_legend(figure: Figure, axes: Axes) -> None:
    """One legend of the orders below all panels."""
    handles, labels = axes.get_legend_handles_labels()
    labels = [rf"{label} order of $\varepsilon_t$" if label in ORDER_COLOURS else label for label in labels]
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))


def figure_error(runs: xarray.Dataset, path: Path) -> list[Path]:
    """Figure 1: squared distance to the stable policy against the iteration, one panel a regime."""
    figure, panels = plt.subplots(1, 3, figsize=(7.4, 2.6), sharey=True, layout="constrained")
    steps = runs["step"].values[1:]
    first = float(runs["error"].isel(step=0).median())
    lowest = float(runs["error"].median("seed").min())
    for axes, regime in zip(panels, REGIME_TITLES, strict=True):
        for order in ORDER_COLOURS:
            values = runs["error"].sel(regime=regime, order=order).values[:, 1:]
            band(axes, steps, *_quantiles(np.minimum(values, 10 * CEILING * first)), order)
        _log_axes(axes)
        axes.set_title(REGIME_TITLES[regime])
        axes.set_xlabel("iteration $n$")
        _guide(axes, float(steps[-1]) / 30, float(steps[-1]), lowest / 3)
    panels[0].set_ylim(float(runs["error"].min()) / 5, CEILING * first)
    panels[0].set_ylabel(r"$\|M_n - M^{\mathrm{PS}}\|_F^2$")
    _orders_legend(figure, panels[0])
    return save_figure(figure, path)


def figure_cost(runs: xarray.Dataset, optimum: xarray.Dataset, path: Path) -> list[Path]:
    """Figure 2: exact performative cost of the iterates; dotted the stable, dash-dotted the optimal policy's."""
    figure, panels = plt.subplots(1, 3, figsize=(7.4, 2.6), layout="constrained")
    steps = runs["step"].values[1:]
    for axes, regime in zip(panels, REGIME_TITLES, strict=True):
        lowest, highest = np.inf, 0.0
        for order, colour in ORDER_COLOURS.items():
            values = runs["cost"].sel(regime=regime, order=order).values
            stable = float(runs["stable_cost"].sel(regime=regime, order=order))
            ceiling = CEILING * np.median(values[:, 0])
            low, middle, high = _quantiles(np.minimum(values[:, 1:], ceiling))
            band(axes, steps, low, middle, high, order)
            axes.axhline(stable, color=colour, linestyle=":", linewidth=1)
            cheapest = float(optimum["cost"].sel(regime=regime, order=order))
            axes.axhline(cheapest, color=colour, **OPTIMUM)
            lowest = min(lowest, stable, cheapest, low.min())
            highest = max(highest, np.median(values[:, 0]), min(middle.max(), 300 * np.median(values[:, 0])))
        _log_axes(axes)
        axes.set_ylim(lowest / 1.6, highest * 1.6)
        axes.set_title(REGIME_TITLES[regime])
        axes.set_xlabel("iteration $n$")
    panels[0].set_ylabel(r"$C_T(M_n; M_n)$")
    panels[0].plot([], [], color="#555555", linestyle=":", linewidth=1, label=r"at $M^{\mathrm{PS}}$")
    panels[0].plot([], [], color="#555555", label=r"at $M^{\mathrm{PO}}$", **OPTIMUM)
    _orders_legend(figure, panels[0])
    return save_figure(figure, path)


def figure_cure(cure: xarray.Dataset, sweep: xarray.Dataset, settings: ReproduceSettings, path: Path) -> list[Path]:
    """Figure 3: the unstable regime with a diminishing step, a smaller step, a bounded set; where divergence begins."""
    figure, panels = plt.subplots(1, 3, figsize=(7.4, 2.7), layout="constrained")
    left, middle, right = panels
    steps = cure["step_diminishing"].values
    for order in ORDER_COLOURS:
        band(left, steps, *_quantiles(cure["diminishing"].sel(order=order).values), order)
    _log_axes(left)
    _guide(left, float(steps[-1]) / 30, float(steps[-1]), float(cure["diminishing"].median("seed").min()) / 2)
    left.set_title(rf"diminishing step ${settings.step_size:g}\cdot 10/(n+10)$")
    left.set_ylabel(r"$\|M_n - M^{\mathrm{PS}}\|_F^2$")

    cures = {"smaller": ("-", "ten times smaller step"), "simplex": ((0, (1, 1)), "same step, simplex")}
    for name in (name for name in cures if name in cure):
        style, label = cures[name]
        n = cure[f"step_{name}"].values
        for order, colour in ORDER_COLOURS.items():
            values = cure[name].sel(order=order).values
            middle.plot(n, np.median(values, axis=0), color=colour, linestyle=style)
            if name == "smaller":
                floor = float(cure["floor_smaller"].sel(order=order))
                middle.axhline(floor, color=colour, linestyle=(0, (4, 3)), linewidth=0.8)
        middle.plot([], [], color="#555555", linestyle=style, label=label)
        if name == "smaller":
            middle.plot([], [], color="#555555", linestyle=(0, (4, 3)), linewidth=0.8, label="its mean-square floor")
    _log_axes(middle)
    middle.set_title("constant steps (medians)")
    middle.set_ylim(bottom=middle.get_ylim()[0] / 12)
    middle.legend(loc="lower left")
    for axes in (left, middle):
        axes.set_xlabel("iteration $n$")

    away = share_that_left(sweep)
    for order, colour in ORDER_COLOURS.items():
        right.plot(
            sweep["factor"],
            100 * away.sel(order=order),
            color=colour,
            marker=ORDER_MARKS[order],
            markersize=4,
            label=order,
        )
    right.axvline(1, color="#555555", linestyle=(0, (4, 3)), linewidth=1)
    right.annotate(
        "mean-square\nthreshold",
        (1, 64),
        xytext=(-10, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        color="#555555",
    )
    right.set_xscale("log")
    ticks = [0.25, 0.5, 1, 2]
    right.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    right.xaxis.set_minor_formatter(NullFormatter())
    right.set_xlabel("constant step / threshold")
    right.set_ylabel("seeds that diverge (%)")
    right.set_title("where divergence begins")
    _orders_legend(figure, left)
    return save_figure(figure, path)
