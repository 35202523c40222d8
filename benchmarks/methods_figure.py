"""The figure of docs/which-method.md: error against deployments above, against time below, a column a class."""

from pathlib import Path
from typing import Any

import numpy as np

from perfcontrol.plotting.style import plt, styled

# colours that colour-blind readers tell apart; what needs the model is drawn in full, what needs episodes alone dashed
LOOKS: dict[str, dict[str, Any]] = {
    "StablePoint()": {"color": "#000000", "marker": "o"},
    "RRM()": {"color": "#0072B2", "marker": "s"},
    "RRM(anderson=3)": {"color": "#009E73", "marker": "D"},
    "RRM(inner_steps=3)": {"color": "#56B4E9", "marker": "v"},
    "RSGD, Exact": {"color": "#7F7F7F"},
    "RSGD": {"color": "#D55E00", "linestyle": "--"},
    "RSGD, batch 16": {"color": "#E69F00", "linestyle": "--"},
    "RSGD, average": {"color": "#882255", "linestyle": "--"},
    "RSGD, Lazy(10)": {"color": "#CC79A7", "linestyle": "--"},
    "RSGD, TwoPoint": {"color": "#999933", "linestyle": ":"},
    "RSGD, EstimatedDynamics, batch 16": {"color": "#332288", "linestyle": ":"},
}
LOWEST, HIGHEST = 1e-8, 30.0
MARKED = (1, 2, 3, 4, 6, 9, 13, 20, 30, 45, 70, 100, 150, 220)  # deployments with a mark


def thinned(x: np.ndarray, count: int = 120) -> np.ndarray:
    """Indices about evenly spaced in the logarithm of x, both ends included."""
    grid = np.geomspace(max(x[1], 1e-12), x[-1], count)
    return np.unique(np.concatenate([[0], np.searchsorted(x, grid), [len(x) - 1]]).clip(0, len(x) - 1))


def draw(traces: dict[str, dict[str, Any]], path: Path) -> None:
    """A PNG at `path`."""
    with styled():
        figure, rows = plt.subplots(
            2, len(traces), figsize=(10.5, 4.9), sharey=True, sharex="row", squeeze=False, layout="constrained"
        )
        for column, (name, found) in enumerate(traces.items()):
            above, below = rows[0][column], rows[1][column]
            above.set_title(name)
            for label, trace in found.items():
                look = {"markersize": 3.2, "linewidth": 1.3} | LOOKS[label]
                errors = np.where(np.isfinite(trace.errors) & (trace.errors < 1e3), trace.errors, np.nan)
                for axes, x in ((above, trace.deployments), (below, 1e3 * trace.seconds)):
                    kept = thinned(x.astype(float))
                    kept = kept[kept > 0]  # the start is at zero
                    marked = [i for i, index in enumerate(kept) if index in MARKED]
                    shown = np.maximum(errors[kept], LOWEST / 10)
                    axes.loglog(x[kept], shown, label=label, markevery=marked, **look)
            for axes in (above, below):
                axes.set_ylim(LOWEST, HIGHEST)
                axes.set_yticks(10.0 ** np.arange(-8, 2, 2))
                axes.minorticks_off()
            above.set_xlim(0.9, 1.3e4)
            below.set_xlim(0.05, 2e4)
            above.set_xlabel("deployments")
            below.set_xlabel("processor time (ms)")
        for axes in rows[:, 0]:
            axes.set_ylabel(r"$\|M - M^{PS}\| \, / \, \|M^{PS}\|$")
        handles: dict[str, Any] = {}
        for axes in rows.flat:
            handles |= {label: line for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        ordered = [label for label in LOOKS if label in handles]
        figure.legend(
            [handles[label] for label in ordered], ordered, loc="outside lower center", ncols=6, handlelength=2.4
        )
        figure.savefig(path, dpi=160, bbox_inches="tight")
        plt.close(figure)
