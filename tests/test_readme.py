"""The examples of the README and of the documentation run as they stand (fragments are fenced as `py`)."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LONG = ("from-data.md",)  # two hundred resampled plants
SNIPPETS = [
    pytest.param(block, id=f"{page.name}-{number}", marks=[pytest.mark.slow] if page.name in LONG else [])
    for page in PAGES[1:]
    if page.name != "tutorial.md"  # its blocks build on one another: tests/test_docs.py
    for number, block in enumerate(re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.M | re.S))
]


@pytest.mark.parametrize("snippet", SNIPPETS)
def test_snippet_runs_as_printed(snippet: str) -> None:
    exec(compile(snippet, "snippet", "exec"), {})


def test_readme_example_finds_the_stable_policy() -> None:
    text = PAGES[0].read_text("utf-8")
    block = re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)[0]
    names: dict = {}
    exec(compile(block, "README.md", "exec"), names)
    pc, problem, stable = names["pc"], names["problem"], names["stable"]
    assert float(pc.residual(problem, stable.M)) < 1e-11
    start = float(((problem.initial_policy() - stable.M) ** 2).sum())
    assert float(((names["sampled"].M - stable.M) ** 2).sum()) < 0.05 * start
    price = pc.price_of_stability(problem)
    printed = [
        float(number) for number in re.search(r"costs here: (\S+), against (\S+) for .*? and (\S+) for", text).groups()
    ]
    found = [price.cost_stable, price.cost_optimal, price.cost_naive]
    assert [round(cost, 1) for cost in found] == printed
    proved = float(re.search(r"costs less than (\S+), which is proved", text).group(1))
    assert proved <= price.bound.lower < proved + 0.1


def test_readme_links_lead_to_files() -> None:
    for target in re.findall(r"\]\(((?!http)[^)#]+)", PAGES[0].read_text("utf-8")):
        assert (ROOT / target).exists(), target
