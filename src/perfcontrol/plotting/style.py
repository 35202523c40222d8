"""One look for all figures: colours that stay apart for colour-blind readers and in print."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from perfcontrol._files import written_whole

ORDER_COLOURS = {"ascending": "#0072B2", "random": "#E69F00", "descending": "#C0392B"}
ORDER_MARKS = {"ascending": "o", "random": "s", "descending": "^"}
REGIME_TITLES = {
    "stable": "almost surely strongly stable",
    "unstable": "almost surely unstable",
    "general": "general",
}

_STYLE: Any = {
    "font.family": ["STIXGeneral", "DejaVu Serif"],  # by name: figures saved outside `styled` keep it
    "mathtext.fontset": "stix",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "figure.dpi": 100,
    "savefig.dpi": 220,
    "svg.fonttype": "path",
    "svg.hashsalt": "perfcontrol",
}


@contextmanager
def styled() -> Iterator[None]:
    """The look, for the figures made inside."""
    with plt.rc_context(_STYLE):
        yield


def band(axes: Axes, x: ArrayLike, low: ArrayLike, middle: ArrayLike, high: ArrayLike, order: str) -> None:
    """A median with its band, in the colour of an order of the sensitivities."""
    axes.fill_between(x, low, high, color=ORDER_COLOURS[order], alpha=0.18, linewidth=0)
    axes.plot(x, middle, color=ORDER_COLOURS[order], label=order)


def save_figure(figure: Figure, path: Path) -> list[Path]:
    """Write PNG and SVG beside each other; `path` has no suffix."""
    engine = figure.get_layout_engine()
    if engine is not None:  # once for both files: the layout takes longer than the drawing
        engine.execute(figure)
        figure.set_layout_engine("none")
    files = []
    for suffix in (".png", ".svg"):
        target = path.with_name(path.name + suffix)
        with written_whole(target) as temporary:
            figure.savefig(temporary, bbox_inches="tight", metadata={"Date": None} if suffix == ".svg" else None)
        files.append(target)
    plt.close(figure)
    return files
