"""The landscape of a problem that reacts: why retraining comes to rest where it does, and what would be cheaper."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from perfcontrol._checks import fail
from perfcontrol.plotting.landscape import Landscape, landscape
from perfcontrol.plotting.style import INK, LOOKS, SHADED, styled
from perfcontrol.plotting.subjects import panels
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.theory import PriceOfStability, price_of_stability
from perfcontrol.theory.price import in_figures

STABLE, OPTIMAL, NAIVE = (LOOKS[name].colour for name in ("stable", "optimal", "naive"))
OWN = SHADED
MARKS: Any = {
    STABLE: {"marker": "o", "markersize": 5.5},
    OPTIMAL: {"marker": "*", "markersize": 10},
    NAIVE: {"marker": "s", "markersize": 6.5},
}
PAPER = LinearSegmentedColormap.from_list("paper", ["#FFFFFF", "#DCE3EA", "#B3C0CD", "#8496A8", "#5C6F82"])
BANDS = 5  # of colour between the optimal and the stable cost
FOLD = 10  # from this ratio on costs are drawn on a logarithmic axis
VIEWS = ("plane", "worlds", "line")
PS, PO = r"M^{\mathrm{PS}}", r"M^{\mathrm{PO}}"


def figure_landscape(
    problem: PerformativeProblem, price: PriceOfStability | None = None, axes: Any = None
) -> np.ndarray:
    """Three views of C_T(M; M'), from the plane of the three policies to the segment between two of them.

    Left: policies on the plane through the stable, the optimal and the naive one. Shades: what each costs in the world
    that it makes, cheapest at the optimal policy. Dashed: what each would cost in the world of the stable policy, whose
    minimum is the stable policy itself.

    Middle: on the line through stable and optimal policy, each column is a world, and a policy that is deployed stands
    on the diagonal. The best response of each column crosses the diagonal at the stable policy; the optimal one is the
    lowest point of the diagonal. Arrows: retraining, on that line, from the optimal policy.

    Right: the diagonal and the two columns as curves. At M^PS nobody gains in the same world; M^PO is cheaper, but
    there a change seems to pay.

    Where the three policies lie on one line (within 2 % of the distance) there is no plane, and the left view is left
    out (empty in `axes` of yours). Hatched: no finite cost. Blank: not feasible.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        price: of `pc.price_of_stability(problem)`; None computes it.
        axes: three Matplotlib axes to draw on; None makes a figure.

    Returns:
        The axes, as an array; `axes[0].figure.savefig(path)` writes the figure.

    Raises:
        InputError: as `pc.price_of_stability`; stable and optimal policy are the same; another number of axes.
    """
    check_problem(problem)
    if axes is not None and np.size(axes) != 3:
        raise fail("axes", f"{np.size(axes)}", "be three Matplotlib axes", "Pass plt.subplots(1, 3)[1].")
    price = price_of_stability(problem) if price is None else price
    found = landscape(problem, price)
    with styled():
        if axes is None:
            count = 2 + found.has_plane
            figure, panels = plt.subplots(1, count, figsize=(2.55 * count, 3.1), layout="constrained")
        else:
            panels = np.asarray(axes, dtype=object).reshape(-1)
            figure = panels[0].figure
            if not found.has_plane:
                panels[0].set_axis_off()
                panels = panels[1:]
        levels = _levels(price, found)
        if found.has_plane:
            _plane(panels[0], price, found, levels)
        _square(panels[-2], price, found, levels)
        _segment(panels[-1], price, found)
        if axes is None:
            figure.legend(handles=_legend(found), loc="outside lower center", ncols=4 if found.has_plane else 3)
    return panels


def plot_landscape(
    problem: PerformativeProblem, price: PriceOfStability | None = None, *, view: str = "worlds", ax: Any = None
) -> Axes:
    """One of the three views of `figure_landscape`, on axes of its own.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        price: of `pc.price_of_stability(problem)`; None computes it.
        view: "plane" (policies about the three), "worlds" (each column a world) or "line" (costs as curves).
        ax: Matplotlib axes; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: as `figure_landscape`; an unknown view; the plane where the three policies lie on one line.
    """
    check_problem(problem)
    if view not in VIEWS:
        raise fail("view", repr(view), f"be one of {VIEWS}", "Pass one of these names.")
    price = price_of_stability(problem) if price is None else price
    with styled():
        return draw_view(panels(ax, 1, (3.0, 2.9))[0], price, landscape(problem, price), view)


def draw_view(axes: Axes, price: PriceOfStability, found: Landscape, view: str) -> Axes:
    """One view of costs that are known."""
    if view == "line":
        _segment(axes, price, found)
    elif view == "worlds":
        _square(axes, price, found, _levels(price, found))
    elif found.has_plane:
        _plane(axes, price, found, _levels(price, found))
    else:
        got = "policies on one line"
        raise fail(
            "view",
            f"'plane' of {got}",
            "be 'worlds' or 'line' here",
            "Pass view='line': there is no plane of the three.",
        )
    return axes


def _levels(price: PriceOfStability, found: Landscape) -> np.ndarray:
    """Where one shade ends: `BANDS` between optimal and stable cost, by differences or, where these differ much, by
    factors."""
    lowest = float(np.nanmin(found.costs))
    if price.ratio is None or price.ratio < FOLD:
        step = price.excess_stable / BANDS
        first = max(np.floor((lowest - price.cost_optimal) / step), -2 * BANDS)
        return price.cost_optimal + step * np.arange(first, 2 * BANDS + 1)
    step = np.log(price.ratio) / BANDS
    first = max(np.floor(np.log(lowest / price.cost_optimal) / step), -2 * BANDS)
    return price.cost_optimal * np.exp(step * np.arange(first, 2 * BANDS + 1))


def _shades(axes: Axes, x: ArrayLike, y: ArrayLike, costs: np.ndarray, levels: np.ndarray) -> None:
    shown = np.where(np.isfinite(costs), costs, np.nan)
    axes.contourf(x, y, shown, levels=levels, cmap=PAPER, extend="both")
    if np.isinf(costs).any():
        axes.contourf(x, y, np.isinf(costs), levels=[0.5, 1.5], colors="none", hatches=["////"])
    axes.grid(False)
    axes.set_aspect("equal")


def _mark(axes: Axes, x: float, y: float, colour: str) -> None:
    axes.plot(
        [x],
        [y],
        color=colour,
        linestyle="none",
        markeredgecolor="white",
        markeredgewidth=0.8,
        zorder=5,
        **MARKS[colour],
    )


def _policies_on(axis: Any) -> None:
    axis.set_ticks([0, 1], [f"${PS}$", f"${PO}$"])


def _plane(axes: Axes, price: PriceOfStability, found: Landscape, levels: np.ndarray) -> None:
    assert (
        found.plane_s is not None and found.plane_t is not None and found.own is not None and found.frozen is not None
    )
    _shades(axes, found.plane_s, found.plane_t, found.own, levels)
    axes.axhline(0, color=OWN, linewidth=0.8, linestyle=(0, (1, 2)))
    above = np.sqrt(np.maximum(found.frozen - price.cost_stable, 0))  # evenly spaced ellipses
    top = np.nanmax(above[np.isfinite(above)])
    axes.contour(
        found.plane_s,
        found.plane_t,
        above,
        levels=top * np.arange(1, 7) / 7,
        colors=STABLE,
        linewidths=0.8,
    )
    _mark(axes, *found.naive, NAIVE)
    _mark(axes, 0.0, 0.0, STABLE)
    _mark(axes, 1.0, 0.0, OPTIMAL)
    _policies_on(axes.xaxis)
    axes.set_yticks([])
    axes.set_xlabel("policy")
    axes.set_title(f"shades: own world; lines: that of ${PS}$")


def _best_responses(found: Landscape) -> np.ndarray:
    """The lowest point of each column of the square: exact, since a column is a parabola; NaN where there is none."""
    lowest = np.full(len(found.s), np.nan)
    for i, column in enumerate(found.costs):
        here = np.isfinite(column)
        if here.sum() >= 3:
            a, b, _ = np.polyfit(found.s[here], column[here], 2)
            lowest[i] = np.clip(-b / (2 * a), found.s[here][0], found.s[here][-1]) if a > 0 else np.nan
    return lowest


def _square(axes: Axes, price: PriceOfStability, found: Landscape, levels: np.ndarray) -> None:
    s = found.s
    _shades(axes, s, s, found.costs.T, levels)
    response = _best_responses(found)
    axes.plot(s, s, color=OWN, linewidth=1.6)
    axes.axvline(0, color=STABLE, linewidth=1)
    axes.axvline(1, color=OPTIMAL, linewidth=1)
    axes.plot(s, response, color=OWN, linewidth=1, linestyle=(0, (4, 2)))
    here = 1.0
    for _ in range(4):  # retraining: down to the best response of a world, then into the world that it makes
        target = float(np.interp(here, s, response))
        if not abs(target - here) > 0.05:
            break
        for start, end in (((here, here), (here, target)), ((here, target), (target, target))):
            axes.annotate(
                "",
                end,
                start,
                arrowprops={"arrowstyle": "-|>", "color": OWN, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0},
            )
        here = target
    if not found.has_plane:
        _mark(axes, found.naive[0], found.naive[0], NAIVE)
    _mark(axes, 0.0, 0.0, STABLE)
    _mark(axes, 1.0, 1.0, OPTIMAL)
    axes.set_xlim(s[0], s[-1])
    axes.set_ylim(s[0], s[-1])
    _policies_on(axes.xaxis)
    _policies_on(axes.yaxis)
    axes.set_xlabel("world made by")
    axes.set_ylabel("policy")
    axes.set_title("each column is a world")


def _segment(axes: Axes, price: PriceOfStability, found: Landscape) -> None:
    s, own = found.s, np.diagonal(found.costs)
    at_stable, at_optimal = found.costs[s == 0.0][0], found.costs[s == 1.0][0]
    low = min(np.nanmin(curve) for curve in (own, at_stable, at_optimal))
    if price.ratio is None or price.ratio < FOLD:
        gap = price.cost_stable - low
        axes.set_ylim(low - 0.15 * gap, price.cost_stable + 0.6 * gap)
    else:
        axes.set_yscale("log")
        axes.set_ylim(low / price.ratio**0.15, price.cost_stable * price.ratio**0.6)
    axes.plot(s, at_stable, color=STABLE, label=f"$C(M; {PS})$")
    axes.plot(s, at_optimal, color=OPTIMAL, label=f"$C(M; {PO})$")
    axes.plot(s, own, color=INK, linewidth=2.2, label="$C(M; M)$")
    axes.plot([0, 1], [price.cost_stable] * 2, color="#555555", linewidth=0.8, linestyle=(0, (1, 2)))
    axes.annotate(
        "",
        (1, price.cost_optimal),
        (1, price.cost_stable),
        arrowprops={"arrowstyle": "<->", "color": "#555555", "linewidth": 0.8},
    )
    if price.ratio is not None:
        text, middle = rf"$\times {in_figures(price.ratio)}$", np.sqrt(price.cost_stable * price.cost_optimal)
        # On this side of the arrow all curves are below or above.
        axes.annotate(text, (1, middle), xytext=(-3, 0), textcoords="offset points", ha="right", va="center")
    if not found.has_plane and price.cost_naive is not None:
        _mark(axes, found.naive[0], price.cost_naive, NAIVE)
    _mark(axes, 0.0, price.cost_stable, STABLE)
    _mark(axes, 1.0, price.cost_optimal, OPTIMAL)
    axes.set_xlim(s[0], s[-1])
    _policies_on(axes.xaxis)
    axes.set_xlabel("policy")
    axes.set_ylabel("$C_T(M; M')$")
    axes.set_title("the diagonal and two columns")


def _legend(found: Landscape) -> list[Line2D]:
    def line(label: str, **style: Any) -> Line2D:
        return Line2D([], [], label=label, **style)

    def mark(label: str, colour: str) -> Line2D:
        return line(label, color=colour, linestyle="none", markeredgecolor="white", **MARKS[colour])

    return [
        mark("stable", STABLE),
        mark("optimal", OPTIMAL),
        mark("naive", NAIVE),
        line("in its own world", color=INK, linewidth=2.2),
        line(f"in the world of ${PS}$", color=STABLE),
        line(f"in the world of ${PO}$", color=OPTIMAL),
        line("best response", color=OWN, linewidth=1, linestyle=(0, (4, 2))),
        line("retraining", color=OWN, linewidth=0.9, marker=">", markersize=5),
    ]
