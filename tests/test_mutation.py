"""The tool behind `make mutation`: which tests a fault is shown to, and that it notices what they do."""

from pathlib import Path

import pytest

from benchmarks import mutation

SOURCE = """\
LIMITS = [
    1,
    2,
]
@decorated
def plan(
    steps=3,
    rate=0.5,
):
    if (
        steps > 4
    ):
        return (
            steps
            - 5
        )
    else:
        return 6
"""


@pytest.mark.parametrize(
    ("line", "lines", "imported"),
    [
        (2, {1, 2, 3, 4}, True),
        (8, {5, 6, 7, 8, 9}, True),
        (11, {10, 11, 12, 17}, False),
        (15, {13, 14, 15, 16}, False),
        (18, {18}, False),
    ],
)
def test_a_line_belongs_to_the_innermost_statement_around_it(line, lines, imported):
    assert mutation.statement(SOURCE, line) == (lines, imported)


def reach(file: str, seconds: float, spent: dict[str, float], lines: dict[int, list[str]]) -> mutation.Reach:
    tests = {f"{file}::{name}": each for name, each in spent.items()}
    contexts = {line: [f"{file}::{name}|run" if name else "" for name in names] for line, names in lines.items()}
    return mutation.Reach(file, seconds, tests, {"perfcontrol/plan.py": contexts})


def ordered(line: int, *reaches: mutation.Reach) -> tuple[list[str], list[str]]:
    fault = mutation.Fault(Path("src/perfcontrol/plan.py"), line, 0, "")
    first, files = mutation.order(fault, SOURCE, reaches)
    return first, [file.file for file in files]


def test_files_that_execute_no_line_of_the_statement_are_left_out_and_cheap_ones_come_first():
    dear = reach("a.py", 50.0, {"quick": 0.1, "other": 0.0, "endless": 2 * mutation.FIRST}, {14: ["quick", "endless"]})
    cheap = reach("b.py", 5.0, {"slow": 2.0, "fast": 1.0}, {13: ["slow"], 15: ["fast"]})
    nowhere = reach("c.py", 1.0, {"beside": 0.0}, {18: ["beside"], 1: [""]})
    assert ordered(15, dear, cheap, nowhere) == (["a.py::quick", "b.py::fast", "b.py::slow"], ["b.py", "a.py"])
    assert ordered(11, dear, cheap, nowhere) == ([], [])


def test_what_an_import_runs_reaches_every_file_that_imports_and_is_shown_to_tests_that_use_the_module():
    importing = reach("a.py", 2.0, {"one": 0.1, "two": 0.0}, {5: ["one"], 7: ["one"], 14: ["two"]})
    collecting = reach("b.py", 1.0, {"three": 0.0}, {5: [""], 7: [""]})
    assert ordered(7, importing, collecting) == (["a.py::two", "a.py::one"], ["b.py", "a.py"])


@pytest.mark.slow
def test_fault_in_a_projection_is_noticed_and_one_that_no_test_executes_is_not():
    found = mutation.reach("tests/sets/test_box.py")
    assert found.tests.keys() >= {"tests/sets/test_box.py::test_box_projection_is_numpy_clip"}
    made = mutation.faults("sets")
    crossed = next(fault for fault in made if fault.file.name == "box.py" and fault.kind == "Sub -> Add")
    assert str(mutation.noticed(crossed, [found])).startswith("tests/sets/test_box.py::")
    elsewhere = next(fault for fault in made if fault.file.name == "newton.py" and fault.kind == "Sub -> Add")
    assert mutation.noticed(elsewhere, [found]) is None
