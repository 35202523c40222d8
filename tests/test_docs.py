"""The pages: the tutorial prints what it says, the slider shows what the library computes."""

import importlib.util
import io
import json
import logging
import re
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def load(name):
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


notebook, hooks, cases = load("notebook"), load("hooks"), load("cases")
TUTORIAL = (DOCS / "tutorial.md").read_text("utf-8")
WORLDS = json.loads(
    (DOCS / "assets" / "worlds-data.js").read_text("utf-8").removeprefix("const WORLDS = ").rstrip(";\n")
)


def assert_same_print(printed, said):
    """Equal words, and numbers up to what platforms differ in."""
    assert NUMBER.sub("#", printed) == NUMBER.sub("#", said)
    for found, expected in zip(NUMBER.findall(printed), NUMBER.findall(said), strict=True):
        assert float(found) == pytest.approx(float(expected), rel=2e-2), printed


def test_tutorial_prints_what_the_page_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # it saves a file
    names = {}
    blocks = [block for block in notebook.blocks(TUTORIAL) if block[1]]
    assert len(blocks) >= 8
    for _, code, said in blocks:
        printed = io.StringIO()
        with redirect_stdout(printed):
            exec(compile(code, "tutorial.md", "exec"), names)
        assert_same_print(printed.getvalue(), said)


def test_numbers_in_the_words_of_the_tutorial_follow_from_what_it_prints():
    lines = "doing nothing costs", "naive, once deployed", "stable, once deployed"
    nothing, naive, stable = (float(re.search(rf"^{line} +(\S+)$", TUTORIAL, re.M)[1]) for line in lines)
    optimal = float(re.search(r"best policy found costs ([\d.]+):", TUTORIAL)[1])
    assert optimal < nothing < naive < stable  # "made things worse", and retraining more so
    assert 0.4 < optimal / stable < 0.6  # "about half"


def test_notebook_has_the_code_and_the_output_of_the_page():
    made = notebook.notebook(TUTORIAL)
    assert (made["nbformat"], made["nbformat_minor"]) == (4, 5)
    code = [cell for cell in made["cells"] if cell["cell_type"] == "code"]
    page = re.findall(r"```python\n(.*?)```", TUTORIAL, re.DOTALL)
    assert [cell["source"] for cell in code] == [block.strip() for block in page]
    assert "".join(out["text"] for cell in code for out in cell["outputs"]).count("Performative control problem") == 1
    words = "".join(cell["source"] for cell in made["cells"] if cell["cell_type"] == "markdown")
    assert "\\[" not in words and "](certificates.md)" not in words and "```python" not in words
    assert len({cell["id"] for cell in made["cells"]}) == len(made["cells"])


COMING_FROM = sorted(page.stem for page in DOCS.glob("from-*.md") if "| Here |" in page.read_text("utf-8"))


@pytest.mark.slow
@pytest.mark.parametrize("name", COMING_FROM)
def test_lines_of_the_tables_for_newcomers_run(name):
    page = (DOCS / f"{name}.md").read_text("utf-8")
    names = {}
    exec(compile(re.search(r"```python\n(.*?)```", page, re.DOTALL)[1], name, "exec"), names)
    cells = re.findall(r"^\|.*\| (`.*`) \|$", page, re.MULTILINE)
    assert len(cells) >= 8
    for line in [line for cell in cells for line in re.findall("`([^`]+)`", cell)]:
        assert eval(line, names) is not None, line


def test_there_is_a_page_for_each_kind_of_newcomer():
    assert COMING_FROM == ["from-jax", "from-performative-prediction", "from-python-control"]


@pytest.mark.slow
@pytest.mark.parametrize("case", cases.CASES)
def test_case_study_prints_what_its_page_says(case):
    page = (DOCS / "cases" / f"{case}.md").read_text("utf-8")
    assert f"python examples/{cases.CASES[case]}.py" in page and f"img/case-{case}.png" in page
    assert_same_print(cases.run(case)[1], cases.PRINTED.search(page)[0])


def cost_by_recursion(share, slope, M, deployed, horizon=30):
    """Second moments of x' = (s + 0.1 ζ) x - M w_before + w from x_0 = 0, where E x_t w_{t-1} = 1 from t = 1 on."""
    s, square, cost = share + slope * deployed, 0.0, 0.0
    for t in range(horizon + 1):
        met = float(t > 0)
        cost += square + 0.1 * M**2 * met
        square = (s**2 + 0.01) * square - 2 * s * M * met + M**2 * met + 1.0
    return cost


@pytest.mark.parametrize("reaction", WORLDS["reactions"], ids=lambda reaction: reaction["name"])
def test_slider_shows_costs_by_recursion_of_second_moments(reaction):
    worlds = WORLDS["low"] + WORLDS["step"] * np.arange(len(reaction["a"]))
    assert worlds[-1] == pytest.approx(WORLDS["high"])
    for i in (0, 45, 100, 160):
        for M in (-0.2, 0.5, 1.1):
            shown = reaction["a"][i] + reaction["b"][i] * M + reaction["c"][i] * M**2
            exact = cost_by_recursion(reaction["share"], reaction["slope"], M, worlds[i])
            assert shown == pytest.approx(exact, abs=1e-5 * reaction["a"][i])
    own = np.array([cost_by_recursion(reaction["share"], reaction["slope"], M, M) for M in worlds])
    response = -np.array(reaction["b"]) / (2 * np.array(reaction["c"]))
    policies = reaction["policies"]
    assert np.interp(policies["stable"][0], worlds, response) == pytest.approx(policies["stable"][0], abs=1e-3)
    assert policies["optimal"][0] == pytest.approx(worlds[own.argmin()], abs=WORLDS["step"])
    for M, cost in policies.values():
        assert cost_by_recursion(reaction["share"], reaction["slope"], M, M) == pytest.approx(cost, rel=1e-5)
    here = np.searchsorted(worlds, policies["stable"][0])
    rate = abs(response[here] - response[here - 1]) / WORLDS["step"]
    assert rate == pytest.approx(reaction["rate"], abs=0.01)


def test_home_page_says_what_the_slider_shows():
    home = (DOCS / "index.md").read_text("utf-8")
    rows = re.findall(r"^\| .*?\*\*(\w+)\*\*.*? \| (\d\.\d+) \| (\d+\.\d) \| (\d+\.\d) \|$", home, re.MULTILINE)
    assert [row[0] for row in rows] == ["naive", "stable", "optimal"]
    reaction = WORLDS["reactions"][1]
    for name, policy, promise, cost in rows:
        M, exact = reaction["policies"][name]
        world = 0.0 if name == "naive" else M
        assert float(policy) == round(M, 2) and float(cost) == round(exact, 1)
        assert float(promise) == round(cost_by_recursion(reaction["share"], reaction["slope"], M, world), 1)


def test_whatever_a_page_would_fetch_from_elsewhere_is_a_warning(tmp_path, caplog):
    good = '<a href="https://arxiv.org">x</a><script src="a.js"></script><img src="b.png"><link href="c.css">'
    (tmp_path / "good.html").write_text(good)
    hooks.on_post_build({"site_dir": str(tmp_path)})
    assert not caplog.records
    for name, text in {
        "script.html": '<script async src="https://unpkg.com/x"></script>',
        "font.css": "@font-face { src: url(https://fonts.example/f.woff2) }",
        "import.css": '@import "//fonts.example/f.css";',
        "image.html": "<img alt='' src='http://example.org/i.png'>",
    }.items():
        (tmp_path / name).write_text(text)
    with caplog.at_level(logging.WARNING):
        hooks.on_post_build({"site_dir": str(tmp_path)})
    assert len(caplog.records) == 4
