"""Every error of the package says what to do next: each call of `fail` in the sources is looked at."""

import ast
import re
import sys
from pathlib import Path

import jax
import pytest

import perfcontrol as pc
from perfcontrol._checks import fail

ROOT = Path(__file__).parents[1] / "src" / "perfcontrol"
ACTIONS = (
    "Add|Begin|Build|Call|Choose|Close|Copy|Correct|Cut|Declare|Deploy|Divide|Drop|Evaluate|Fill|Give|Install|Leave|"
    "Let|Log|Lower|Name|Pass|Print|Put|Raise|Reduce|Relax|Remove|Rename|Replace|Rescale|Restore|Retrain|Return|Run|Save|"
    "Separate|Shorten|Solve|Start|Swap|Take|Use|Wait|Weigh|Write"
)
ACTION = re.compile(rf"(?:^|[.;:,] |\bor |{{}} ?)(?:{ACTIONS})\b", re.IGNORECASE)


def words(node):
    """The text of a string expression; `{}` for what is computed, alternatives joined by "|"; None for a variable."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=values):
            return "".join(words(value) or "{}" for value in values)
        case ast.FormattedValue():
            return "{}"
        case ast.BinOp(op=ast.Add(), left=left, right=right):
            return (words(left) or "{}") + (words(right) or "{}")
        case ast.IfExp(body=body, orelse=other):
            return " | ".join(filter(None, [words(body), words(other)]))
        case ast.BoolOp(values=values):
            return " | ".join(filter(None, map(words, values)))
    return None


CALLS = {
    f"{path.relative_to(ROOT)}:{call.lineno}": call
    for path in sorted(ROOT.rglob("*.py"))
    for call in ast.walk(ast.parse(path.read_text("utf-8")))
    if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "fail"
}


def says_what_to_do(remedy):
    """Whether each alternative starts a sentence with an action, and ends as a sentence."""
    return all(ACTION.search(part) and part.rstrip()[-1] in ".)}`" for part in remedy.split(" | "))


def test_calls_were_found():
    assert len(CALLS) > 250


def test_every_error_has_four_parts_and_a_remedy_that_can_be_followed():
    assert all(len(call.args) == 4 and not call.keywords for call in CALLS.values())
    remedies = {place: words(call.args[3]) for place, call in CALLS.items()}
    assert {place: text for place, text in remedies.items() if text and not says_what_to_do(text)} == {}
    assert not [place for place, call in CALLS.items() if (words(call.args[2]) or "").startswith("must")]


@pytest.mark.parametrize("vague", ["Mend it.", "Check the path.", "It bounds a norm.", "One entry a stage.", "Pass 1"])
def test_vague_remedies_are_told_apart(vague):
    assert not says_what_to_do(vague)


def test_array_in_a_message_is_cut_after_its_first_line():
    message = str(fail("batch", "Array([[1.0],\n [2.0]])", "be an integer", "Pass 1."))
    assert message == "`batch` must be an integer; got Array([[1.0], .... Pass 1."


@pytest.mark.parametrize("kind", ["paper", "rigorous", "global", "sharp"])
def test_what_a_certificate_misses_names_an_argument_with_an_example(kind):
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5]], [[1.0]]),
        horizon=4,
        noise=pc.Gaussian([0.1], [[1.0]]),  # a mean, and no bound
        cost=pc.ConvexCost(lambda t, x, u: x @ x + u @ u),  # constants that nobody knows
        perturbation=pc.SampledPerturbation(lambda key, M: jax.random.normal(key, (4, 1, 1))),  # unknown moments
    )
    missing = pc.certify(problem, kind).missing
    assert missing
    for line in missing:
        assert re.search(r"\b(?:pass|use|declare|build|state)\b.*(?:=|pc\.\w+\()", line), line


def test_command_without_its_packages_says_what_to_install(monkeypatch):
    from perfcontrol.__main__ import main

    monkeypatch.setitem(sys.modules, "typer", None)
    for name in [name for name in sys.modules if name.startswith("perfcontrol.cli")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(SystemExit, match=r"needs typer\. Install it with pip install 'perfcontrol\[app\]'"):
        main()
