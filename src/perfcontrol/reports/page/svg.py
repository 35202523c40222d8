"""Matplotlib figures as SVG inside a page: no addresses, ids of their own, the colours of the page."""

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from perfcontrol.plotting.style import GRID, INK, LOOKS, OTHER_LOOKS, styled

MUTED = "#555555"
# Colours of the figures that the page names anew, once for light and once for dark.
NAMES = {INK: "currentColor", GRID: "var(--grid)", MUTED: "var(--muted)"}
NAMES |= {look.colour: f"var(--{name})" for name, look in LOOKS.items()}
NAMES |= {look.colour: f"var(--other-{i})" for i, look in enumerate(OTHER_LOOKS)}


class Drawing(NamedTuple):
    """A figure as SVG and its width in points."""

    svg: str
    width: float


@contextmanager
def canvas(width: float, height: float) -> Iterator[tuple[Figure, Axes]]:
    """A figure of one axes in inches, apart from pyplot."""
    with styled():
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure, figure.subplots()


def draw(width: float, height: float, alt: str, prefix: str, plot: Callable[[Axes], object]) -> Drawing:
    """What `plot` draws on axes of that size; `alt` says it in words, `prefix` keeps ids apart."""
    with canvas(width, height) as (figure, axes):
        plot(axes)
        written = io.StringIO()
        figure.savefig(written, format="svg", transparent=True, metadata={"Date": None})
        return Drawing(inline(written.getvalue(), alt, prefix), figure.get_figwidth() * 72)


def inline(svg: str, alt: str, prefix: str) -> str:
    """SVG of Matplotlib for use inside HTML.

    Examples:
        >>> inline('<svg xmlns="http://x" viewBox="0 0 1 1"><g id="a"/><use xlink:href="#a"/></svg>', "dot", "f1")
        '<svg viewBox="0 0 1 1" role="img" aria-label="dot"><g id="f1-a"/><use href="#f1-a"/></svg>'
    """
    body = svg[svg.index("<svg") :]
    opening, _, body = body.partition(">")
    box = re.search(r'viewBox="([^"]*)"', opening)
    assert box is not None
    for pattern in (r"<metadata>.*?</metadata>", r"<style[^>]*>.*?</style>", r"<!--.*?-->", r' xmlns(:\w+)?="[^"]*"'):
        body = re.sub(pattern, "", body, flags=re.DOTALL)
    used = set(re.findall(r"#([\w-]+)[\")]", body))  # other ids name groups, which nobody refers to
    body = re.sub(r' id="([^"]*)"', lambda m: f' id="{prefix}-{m[1]}"' if m[1] in used else "", body)
    body = re.sub(r'(?:xlink:)?href="#([^"]*)"', rf'href="#{prefix}-\1"', body)
    body = re.sub(r"url\(#([^)]*)\)", rf"url(#{prefix}-\1)", body)
    body = re.sub(r' d="([^"]*)"', lambda m: f' d="{_shortened(m[1])}"', body)
    for colour, name in NAMES.items():
        body = re.sub(re.escape(colour), name, body, flags=re.IGNORECASE)
    body = re.sub(r"\s*\n\s*", "\n", body).strip()
    return f'<svg viewBox="{box[1]}" role="img" aria-label="{escape(alt)}">{body}'


def _shortened(path: str) -> str:
    """Coordinates to a hundredth of a point, on one line."""
    return " ".join(re.sub(r"(\.\d\d)\d+", r"\1", path).split())
