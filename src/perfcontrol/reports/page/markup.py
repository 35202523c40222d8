"""The few pieces of HTML that a report is made of. Text is escaped here, and nowhere else."""

import re
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np


class Html(str):
    """Text that is HTML already."""


class Section(NamedTuple):
    """One part of the page: its anchor, its heading, what stands below."""

    anchor: str
    heading: str
    body: Html


SCRIPT = re.compile(r"((?<!\w)\w|[∇‖)\]])([_^])(\{[^{}]+\}|\w+)")


def text(value: Any) -> Html:
    """Anything as escaped text; HTML as it is. x_t, M^PS, ‖M‖_F and `code` are set as such."""
    if isinstance(value, Html):
        return value
    pieces = escape(str(value)).split("`")  # every other one stood between backticks
    return Html(
        "".join(SCRIPT.sub(_script, one) if i % 2 == 0 else f"<code>{one}</code>" for i, one in enumerate(pieces))
    )


def _script(match: re.Match[str]) -> str:
    tag = "sub" if match[2] == "_" else "sup"
    return f"{match[1]}<{tag}>{match[3].strip('{}')}</{tag}>"


def number(value: Any, figures: int = 6) -> Html:
    """A number as people read it, with all its digits for programs."""
    if value is None:
        return Html("unknown")
    value = float(value)
    if not np.isfinite(value):
        return Html("infinite" if value > 0 else "−infinite" if value < 0 else "not a number")
    shown = f"{value:.{figures}g}"
    if "e" in shown and 1 <= abs(value) < 1e7:
        shown = f"{float(shown):.0f}"  # 16000, and not 1.6e+04
    return Html(f'<data value="{value!r}">{shown.replace("-", "−")}</data>')


def joined(parts: Iterable[Any]) -> Html:
    """Parts one after the other."""
    return Html("".join(text(part) for part in parts))


def paragraph(*parts: Any) -> Html:
    """Sentences."""
    return Html(f"<p>{' '.join(text(part) for part in parts)}</p>\n")


def missing(reason: str) -> Html:
    """Why something is not shown."""
    return Html(f'<p class="missing"><strong>Not shown.</strong> {text(reason)}</p>\n')


def bullets(items: Iterable[Any]) -> Html:
    """A list."""
    return Html("<ul>" + "".join(f"<li>{text(item)}</li>" for item in items) + "</ul>\n")


def subheading(title: str) -> Html:
    """A heading inside a section."""
    return Html(f"<h3>{text(title)}</h3>\n")


def table(caption: str, header: Sequence[Any], rows: Iterable[Sequence[Any]]) -> Html:
    """A table whose first column names the rows; it scrolls by itself where it is wider than the page."""
    head = "".join(f'<th scope="col">{text(cell)}</th>' for cell in header)
    lines = []
    for first, *others in rows:
        cells = "".join(f"<td>{text(cell)}</td>" for cell in others)
        lines.append(f'<tr><th scope="row">{text(first)}</th>{cells}</tr>')
    return Html(
        f'<div class="wide" role="region" tabindex="0" aria-label="{escape(caption)}"><table><caption>{text(caption)}'
        f"</caption><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>\n"
    )


def figures(drawings: Sequence[Any], caption: Any, headings: Sequence[Any] = ()) -> Html:
    """Drawings side by side, as many as there is room for, each below its heading if it has one, under one caption."""
    titles = [subheading(one) for one in headings] or [""] * len(drawings)
    width = max((one.width for one in drawings), default=0.0)  # in points, of which a pixel is 3/4
    parts = "".join(f"<div>{title}{one.svg}</div>" for one, title in zip(drawings, titles, strict=True))
    panels = f'<div class="panels" style="--width:{width:.0f}px">{parts}</div>'
    return Html(f"<figure>{panels}<figcaption>{text(caption)}</figcaption></figure>\n")
