"""The page itself: one file, no address in it, light and dark, on paper, by keyboard."""

from collections.abc import Sequence
from html import escape

from perfcontrol.reports.page.markup import Html, Section, text

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"

STYLE = """
:root { color-scheme: light dark; --page: #ffffff; --ink: #1a1a1a; --muted: #555555; --grid: #dddddd; --line: #c8c8c8;
  --box: #f3f5f7; --link: #0b5394; --stable: #c0392b; --optimal: #0072b2; --naive: #b97c00; --other-0: #00805c;
  --other-1: #b1568a; --other-2: #2a8cc4; --other-3: #737373; }
@media (prefers-color-scheme: dark) { :root { --page: #14171a; --ink: #e6e6e6; --muted: #a8a8a8; --grid: #3a3f44;
  --line: #50565c; --box: #1f2429; --link: #8ab8e8; --stable: #f07f70; --optimal: #5cb3ea; --naive: #f0b243;
  --other-0: #3cc79b; --other-1: #e19ac1; --other-2: #8fd0f5; --other-3: #a6a6a6; } }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; }
@media (prefers-reduced-motion: reduce) { html { scroll-behavior: auto; } }
body { margin: 0; background: var(--page); color: var(--ink); font: 1rem/1.55 system-ui, sans-serif; }
header, main, nav { max-width: 62rem; margin: 0 auto; padding: 0 1.2rem; }
h1 { font-size: 1.8rem; line-height: 1.2; margin: 1.6rem 0 .4rem; }
h2 { font-size: 1.35rem; margin: 2.6rem 0 .6rem; padding-top: .6rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.4rem 0 .3rem; }
p, li { max-width: 46rem; overflow-wrap: break-word; }
a { color: var(--link); }
a:focus-visible, [tabindex]:focus-visible { outline: 3px solid var(--link); outline-offset: 2px; }
.skip { position: absolute; left: -999rem; }
.skip:focus { left: 1rem; top: .5rem; background: var(--page); padding: .4rem .8rem; z-index: 1; }
.by { color: var(--muted); margin: 0 0 1rem; }
.short { background: var(--box); border-left: 4px solid var(--optimal); padding: .7rem 1.2rem; margin: 1rem 0; }
.short p { margin: .4rem 0; }
.missing { border-left: 4px solid var(--naive); padding: .2rem 0 .2rem .9rem; }
nav ol { columns: 18rem; padding-left: 1.4rem; margin: .6rem 0; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--muted); padding-bottom: .3rem; max-width: 46rem; }
th, td { text-align: left; vertical-align: top; padding: .3rem 1rem .3rem 0; border-bottom: 1px solid var(--line); }
thead th { border-bottom-width: 2px; }
tbody th { font-weight: 600; }
figure { margin: 1.2rem 0; }
figcaption { color: var(--muted); max-width: 46rem; font-size: .95rem; }
.panels { display: grid; gap: 1rem 1.4rem; align-items: end;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, calc(1.12 * var(--width))), 1fr)); }
.panels > div { max-width: calc(1.4 * var(--width)); }
svg { display: block; width: 100%; height: auto; color: var(--ink); }
svg * { stroke-linejoin: round; stroke-linecap: butt; }
.legend span { margin-right: 1.4rem; white-space: nowrap; }
.legend svg { display: inline-block; width: 2.6rem; vertical-align: middle; }
code { font-size: .92em; }
@media (max-width: 36rem) {
  table { font-size: .88rem; }
  th, td { padding-right: .6rem; overflow-wrap: anywhere; min-width: 4.5rem; }
}
@media print {
  :root { --page: #ffffff; --ink: #000000; --muted: #444444; --grid: #dddddd; --line: #bbbbbb; --box: #ffffff;
    --link: #000000; --stable: #c0392b; --optimal: #0072b2; --naive: #b97c00; }
  nav, .skip { display: none; }
  body { font-size: 10pt; }
  h2, h3 { break-after: avoid; }
  figure, tr, .short { break-inside: avoid; }
  .wide { overflow: visible; }
  .panels { grid-template-columns: repeat(auto-fill, minmax(min(100%, var(--width)), 1fr)); }
}
"""


def document(title: str, byline: str, short: Html, sections: Sequence[Section]) -> str:
    """The whole page."""
    contents = "".join(f'<li><a href="#{one.anchor}">{text(one.heading)}</a></li>' for one in sections)
    body = "".join(
        f'<section id="{one.anchor}" aria-labelledby="{one.anchor}-heading"><h2 id="{one.anchor}-heading">'
        f"{text(one.heading)}</h2>\n{one.body}</section>\n"
        for one in sections
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{escape(title)}</title>\n'
        f'<link rel="icon" href="data:,">\n<style>{STYLE}</style>\n</head>\n<body>\n'
        f'<a class="skip" href="#main">Skip to the report</a>\n'
        f'<header><h1>{text(title)}</h1>\n<p class="by">{text(byline)}</p></header>\n'
        f'<nav aria-label="Contents"><ol>{contents}</ol></nav>\n'
        f'<main id="main" tabindex="-1">\n<div class="short" role="region" aria-label="In short">{short}</div>\n{body}'
        f"</main>\n</body>\n</html>\n"
    )
