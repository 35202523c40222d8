"""The distribution of the cost over paths, policy by policy: not only what is expected, but what may come."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from perfcontrol._checks import fail
from perfcontrol.plotting.style import looks, styled
from perfcontrol.plotting.subjects import as_paths, panels, plain
from perfcontrol.problem import PerformativeProblem

BINS = 40
SKEWED = 15.0  # from this ratio of a high to a low cost on the axis is logarithmic


def plot_costs(
    problem: PerformativeProblem,
    policies: Any,
    *,
    key: Any = None,
    samples: int = 2048,
    truncation: int | None = None,
    ax: Any = None,
) -> Axes:
    """How the cost is distributed over paths under each policy in the world that it makes; upright lines: the means.

    One path in 200 is beyond either end of the axis.

    Args:
        problem: the problem.
        policies: as of `plot_trajectories`.
        key: JAX random key; required unless all paths are given.
        samples: paths of each policy.
        truncation: time steps of an infinite horizon over which costs are averaged; None for 100.
        ax: Matplotlib axes; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: as `pc.simulate`; fewer than two paths.
        OverflowError: costs that are no numbers.
    """
    costs = {
        name: np.asarray(paths.cost, dtype=float)
        for name, paths in as_paths(problem, policies, key, samples, truncation).items()
    }
    for name, values in costs.items():
        if values.size < 2:
            raise fail("samples", f"{values.size} of {name!r}", "be at least 2 paths", "Pass samples=2048.")
        if not np.isfinite(values).all():
            raise OverflowError(f"Costs of paths under {name!r} are too large for the precision of the problem.")
    ends = np.array([np.quantile(values, [0.005, 0.995]) for values in costs.values()])
    low, high = float(ends[:, 0].min()), float(ends[:, 1].max())
    skewed = low > 0 and high > SKEWED * low
    if high <= low:
        low, high = low - 0.5 * max(abs(low), 1.0), high + 0.5 * max(abs(high), 1.0)
    edges = np.geomspace(low, high, BINS + 1) if skewed else np.linspace(low, high, BINS + 1)
    styles = looks(costs)
    with styled():
        axes = panels(ax, 1, (4.2, 2.8))[0]
        for name, values in costs.items():
            look = styles[name]
            share = np.histogram(values, edges)[0] / values.size
            axes.stairs(100 * share, edges, color=look.colour, linestyle=look.line, linewidth=1.3, label=plain(name))
            axes.stairs(100 * share, edges, color=look.colour, alpha=0.12, fill=True)
            axes.axvline(float(values.mean()), color=look.colour, linestyle=look.line, linewidth=0.9)
        if skewed:
            axes.set_xscale("log")
        axes.set_xlim(low, high)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("cost of a path" if problem.is_finite else "cost of a path, per stage")
        axes.set_ylabel("paths (%)")
        if len(costs) > 1:
            axes.legend()
    return axes
