"""One look for all figures: colours that stay apart for colour-blind readers and in print."""

import itertools
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
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

INK, GRID = "#1A1A1A", "#DDDDDD"  # of text, frames and grids; reports replace them by the colours of their page
SHADED = "#222222"  # lines on shades of grey, which stay light on every page


class Look(NamedTuple):
    """How one curve differs from the others: by colour, and without colours by line and mark."""

    colour: str
    line: Any
    mark: str


LOOKS = {
    "stable": Look("#C0392B", "-", "o"),
    "optimal": Look("#0072B2", (0, (6, 1.5)), "*"),
    "naive": Look("#E69F00", (0, (3, 1.2, 1, 1.2)), "s"),
}
OTHER_LOOKS = (
    Look("#009E73", (0, (1.2, 1.2)), "^"),
    Look("#CC79A7", (0, (5, 1, 1, 1, 1, 1)), "D"),
    Look("#56B4E9", (0, (8, 2)), "v"),
    Look("#7F7F7F", (0, (2, 2)), "P"),
)
# Signed numbers: orange below zero, blue above, both dark at the ends also in grey.
SIGNED = LinearSegmentedColormap.from_list(
    "signed", ["#7F3B08", "#E08214", "#FBE3C4", "#F7F7F7", "#CFE3F2", "#4393C3", "#053061"]
)

_STYLE: Any = {
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
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
    "grid.color": GRID,
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


def looks(names: Iterable[str]) -> dict[str, Look]:
    """A look for each name: the three policies have theirs, whatever else is drawn; others take turns."""
    spare = itertools.cycle(OTHER_LOOKS)
    return {name: LOOKS.get(name) or next(spare) for name in names}


def save_figure(figure: Figure, path: Path) -> list[Path]:
    """Write PNG and SVG beside each other; `path` has no suffix."""
    engine, files = figure.get_layout_engine(), []
    if engine is not None:  # once for both files, and as the first of them is drawn, whose text need not be set again
        if plt.rcParams["savefig.dpi"] != "figure":
            figure.set_dpi(plt.rcParams["savefig.dpi"])
        engine.execute(figure)
        figure.set_layout_engine("none")
    for suffix in (".png", ".svg"):
        target = path.with_name(path.name + suffix)
        with written_whole(target) as temporary:
            figure.savefig(temporary, metadata={"Date": None} if suffix == ".svg" else None)
        files.append(target)
    plt.close(figure)
    return files
