"""A policy as a heat map: which past disturbance moves which input, lag by lag."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from perfcontrol._checks import fail
from perfcontrol.plotting.style import SIGNED, styled
from perfcontrol.plotting.subjects import input_names, panels, plain, state_names
from perfcontrol.problem import PerformativeProblem, check_problem

WRITTEN = 60  # entries up to which each is written into its cell
NAMED = 12  # rows or columns up to which each has its name; of more, so many evenly spaced ones
LETTERS = 18  # of a name that are shown


def plot_policy(problem: PerformativeProblem, M: Any, *, limit: float | None = None, ax: Any = None) -> Axes:
    """The policy lag by lag: the entry in row j and column k of lag i is what w_{t-i}[k] adds to u_t[j].

    Args:
        problem: the problem.
        M: free policy parameters, `problem.policy_shape`; the lifted policy is drawn.
        limit: of the colours, -limit to limit, the same for policies to be compared; None for the largest entry.
        ax: Matplotlib axes; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: a policy of the wrong shape; a limit that is not positive.
    """
    lifted = np.asarray(check_problem(problem).lift(M))
    lags, rows, states = lifted.shape
    columns = lags * states
    stack = np.concatenate(list(lifted), axis=1)
    largest = float(np.max(np.abs(stack), initial=0.0)) or 1.0
    if limit is not None:
        largest = float(limit)
        if not 0 < largest < np.inf:
            raise fail("limit", f"{limit}", "be positive", "Pass the largest entry of the policies, or leave it out.")
    with styled():
        axes = panels(ax, 1, heat_map_size(problem))[0]
        edges = np.arange(columns + 1), np.arange(rows + 1)
        mesh = axes.pcolormesh(
            *edges, stack, cmap=SIGNED, vmin=-largest, vmax=largest, edgecolors="white", linewidth=0.4
        )
        axes.invert_yaxis()
        for lag in range(1, lags):
            axes.axvline(lag * states, color="white", linewidth=4)
        if columns <= NAMED and stack.size <= WRITTEN:
            for (j, k), value in np.ndenumerate(stack):
                shade = "white" if abs(value) > 0.62 * largest else "black"
                axes.text(k + 0.5, j + 0.5, f"{value:.2g}", ha="center", va="center", fontsize=7, color=shade)
        else:
            axes.figure.colorbar(mesh, ax=axes, shrink=0.9, pad=0.02, aspect=12)
        _label(axes, problem, lags)
    return axes


def heat_map_size(problem: PerformativeProblem) -> tuple[float, float]:
    """Width and height in inches that suit `plot_policy`."""
    lags, rows, states = problem.lifted_shape
    names = [_short(name) for name in state_names(problem)]
    below = 0.07 * max(map(len, names)) if _turned(problem, names) else 0.0
    return min(max(2.2, 1.1 + 0.42 * lags * states), 4.4), min(max(1.3, 1.0 + 0.34 * rows), 3.8) + below


def _turned(problem: PerformativeProblem, names: list[str]) -> bool:
    """Whether names of the states are too long to stand side by side."""
    columns = problem.lifted_shape[0] * len(names)
    return columns <= NAMED and max(map(len, names)) * 0.075 > max(0.4, 1.6 / columns)


def _short(name: str) -> str:
    return plain(name if len(name) <= LETTERS else name[: LETTERS - 1] + "…")


def _label(axes: Axes, problem: PerformativeProblem, lags: int) -> None:
    rows, states = problem.input_size, problem.state_size
    axes.grid(False)
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    inputs = range(0, rows, math.ceil(rows / NAMED))
    axes.set_yticks([row + 0.5 for row in inputs], [_short(input_names(problem)[row]) for row in inputs])
    axes.set_ylabel("input")
    names = [_short(name) for name in state_names(problem)]
    apart = math.ceil(lags * states / NAMED) if lags * states > NAMED else 1
    named = [(lag, state) for lag in range(lags) for state in range(0, states, apart)]
    turned = apart > 1 or _turned(problem, names)
    axes.set_xticks([lag * states + state + 0.5 for lag, state in named], [names[state] for _, state in named])
    axes.tick_params(axis="x", labelrotation=90 if turned else 0)
    axes.set_xlabel("disturbance of")
    top = axes.secondary_xaxis("top")
    shown = range(0, lags, math.ceil(lags / 8))
    top.set_xticks([states * (lag + 0.5) for lag in shown], [f"lag {lag + 1}" for lag in shown])
    top.tick_params(length=0)
    top.spines["top"].set_visible(False)
