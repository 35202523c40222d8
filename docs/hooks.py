"""Build-time mathematics: every equation of a page becomes MathML, which browsers draw without any script.

`pymdownx.arithmatex` leaves an equation as escaped LaTeX inside an element of class `arithmatex`. After a
page, its docstrings included, has become HTML, `on_page_content` replaces each of them. LaTeX that cannot be
translated is reported as a warning, so that a strict build fails instead of showing half an equation.
"""

from __future__ import annotations

import html
import logging
import re
from xml.etree import ElementTree

from latex2mathml.converter import convert

log = logging.getLogger("mkdocs.hooks.mathml")

EQUATION = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?:\((?P<inline>.*?)\\\)|\[(?P<block>.*?)\\\])</(?P=tag)>',
    re.DOTALL,
)

# Common LaTeX that the translator lacks, written with what it has.
REWRITES = (
    (re.compile(r"\\operatorname\*?\{\s*arg\s*\\?,?\s*(min|max)\s*\}"), r"\\mathrm{arg}\\,\\\1"),
    (re.compile(r"\\arg\s*\\(min|max)"), r"\\mathrm{arg}\\,\\\1"),
    (re.compile(r"\\operatorname\*"), r"\\operatorname"),
    (re.compile(r"\\(begin|end)\{aligned\}"), r"\\\1{align*}"),
)


def to_mathml(latex: str, display: str) -> str:
    """Translate one equation; raises ValueError where some of it is not understood."""
    for pattern, replacement in REWRITES:
        latex = pattern.sub(replacement, latex)
    try:
        mathml = convert(latex.strip(), display=display)
        root = ElementTree.fromstring(mathml)
    except Exception as error:  # the translator has no common base class for its errors
        raise ValueError(f"{type(error).__name__} {error}".strip()) from error
    unknown = sorted({text for text in root.itertext() if "\\" in text})
    if unknown:
        raise ValueError(f"unknown commands {', '.join(unknown)}")
    return mathml


def on_page_content(content: str, *, page, **_) -> str:
    """Replace the equations of one page."""

    def replace(match: re.Match[str]) -> str:
        display = "inline" if match["block"] is None else "block"
        latex = html.unescape(match["inline"] if match["block"] is None else match["block"])
        try:
            mathml = to_mathml(latex, display)
        except ValueError as error:
            log.warning("%s: equation not understood (%s): %s", page.file.src_uri, error, latex.strip())
            return match[0]
        return f'<{match["tag"]} class="equation-{display}">{mathml}</{match["tag"]}>'

    return EQUATION.sub(replace, content)
