"""`python -m benchmarks.mutation [--count N] [--seed S] [ROOM ...]`: would the tests notice if the code were wrong?

Draws small faults (a sign, a comparison, a constant, a factor) all over the rooms, each in a copy of the package, and
runs the tests of that room until the first failure. Prints the share of faults that were noticed and every one that
was not: some of those change nothing that anybody could see, each is worth a look. Fails where the share is below
`--least` percent.

First each file of tests runs once without a fault, to see which lines it executes. A file that never executes the
faulty line cannot notice the fault and is left out. The unit is the file, in a process of its own: JAX traces a
function once, so that which test of a file executes a line depends on the tests before. The tests that did are only
tried first. An execution that is not observed can only lower the share.
"""

import argparse
import ast
import copy
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from coverage import CoverageData

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "perfcontrol"
TESTS = {  # the tests of a room
    "evaluate": ["tests/evaluate", "tests/response", "tests/test_kernel.py", "tests/test_properties.py"],
    "response": ["tests/response", "tests/solvers"],
    "solvers": ["tests/solvers"],
    "sets": ["tests/sets", "tests/response"],
    "perturbations": ["tests/perturbations", "tests/evaluate"],
    "policy_maps": ["tests/test_policy_maps.py", "tests/perturbations"],
    "random_vectors": ["tests/test_random_vectors.py"],
    "costs": ["tests/costs", "tests/evaluate"],
    "theory": ["tests/theory"],
}
FIRST = 60.0  # seconds of tests that are tried before whole files
PATIENCE = 10  # times what tests take without a fault: a fault compiles anew, one that takes longer is endless
LONGEST = 1800  # seconds of a core that a file of tests may take without a fault
NOT_FOUND = 4  # exit status where a test that was asked for is not there: its name has changed with the fault
NO_TESTS = 5  # exit status where all tests of a file are slow ones
MANY = 50  # of so many samples, steps or rows one more makes no difference
SWAPS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip

Result = subprocess.CompletedProcess[str]


class Fault(NamedTuple):
    """One change: the file, the line, the node's place in the walk, what it was and what it became."""

    file: Path
    line: int
    place: int
    kind: str


def _code(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes that compute: no annotations, no messages of errors, no limits.

    A limit (how near, how long, how much at once; a number in capitals) may have another value and be as right.
    """
    skipped: set[int] = set()
    for node in ast.walk(tree):
        limit = isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).isupper()
        limit |= isinstance(node, ast.keyword) and node.arg in ("strict", "static", "batch_size")
        if limit or isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.JoinedStr):
            skipped |= {id(inner) for inner in ast.walk(node)}
        for name in ("annotation", "returns", "decorator_list"):
            part = getattr(node, name, None)
            for root in part if isinstance(part, list) else [part]:
                if isinstance(root, ast.AST):
                    skipped |= {id(inner) for inner in ast.walk(root)}
    return (node for node in ast.walk(tree) if id(node) not in skipped)


def _mutable(node: ast.AST) -> str | None:
    """What can be changed about a node, in words; None for nothing."""
    if isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in SWAPS:
        return f"{type(node.op).__name__} -> {SWAPS[type(node.op)].__name__}"
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        return f"{type(node.ops[0]).__name__} -> {SWAPS[type(node.ops[0])].__name__}"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
        return "sign dropped"
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float) and node.value < MANY:
        return f"{node.value} -> {_changed(node.value)}"
    return None


def _changed(value: bool | int | float) -> bool | int | float:
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) else (3 * value if value else 1.0)


def faults(room: str) -> list[Fault]:
    """Every fault that can be made in a room."""
    found = []
    place = PACKAGE / room
    for file in sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
        for index, node in enumerate(_code(ast.parse(file.read_text(encoding="utf-8")))):
            kind = _mutable(node)
            if kind is not None:
                found.append(Fault(file.relative_to(ROOT), getattr(node, "lineno", 0), index, kind))
    return found


def with_fault(source: str, fault: Fault) -> str:
    """The module with the fault in it."""
    tree = copy.deepcopy(ast.parse(source))
    node = next(node for index, node in enumerate(_code(tree)) if index == fault.place)
    if isinstance(node, ast.BinOp | ast.BoolOp):
        node.op = SWAPS[type(node.op)]()  # type: ignore[assignment]
    elif isinstance(node, ast.Compare):
        node.ops[0] = SWAPS[type(node.ops[0])]()  # type: ignore[assignment]
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd()
    elif isinstance(node, ast.Constant):
        node.value = _changed(node.value)  # type: ignore[arg-type]
    return ast.unparse(tree)


def _files(room: str) -> list[str]:
    """The files of tests of a room."""
    places = [ROOT / name for name in TESTS[room]]
    files = [file for place in places for file in (sorted(place.rglob("test_*.py")) if place.is_dir() else [place])]
    return [str(file.relative_to(ROOT)) for file in files]


def statement(source: str, line: int) -> tuple[set[int], bool]:
    """The lines of the statement around a line, without those of statements inside it; whether an import runs it."""
    statements = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt)]
    *outer, own = (node for node in statements if node.lineno <= line <= (node.end_lineno or 0))
    inner = [node for node in ast.walk(own) if isinstance(node, ast.stmt) and node is not own]
    lines = _lines(own).difference(*map(_lines, inner)) | {own.lineno}
    return lines, not any(isinstance(node, ast.FunctionDef) for node in outer)


def _lines(node: ast.stmt) -> set[int]:
    decorators = getattr(node, "decorator_list", [])
    return set(range(min(part.lineno for part in (node, *decorators)), (node.end_lineno or 0) + 1))


def _run(arguments: Iterable[str], seconds: float, fault: tuple[Path, str] | None = None, **environment: str) -> Result:
    """Run tests on a copy of the package, which may have a fault in it, for so many seconds of a core at most."""
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "src" / "perfcontrol"
        shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
        if fault is not None:
            (Path(folder) / fault[0]).write_text(fault[1], encoding="utf-8")
        listed = Path(folder) / "arguments"  # in a file: there may be thousands
        listed.write_text("\n".join(arguments), encoding="utf-8")
        environment = os.environ | {"PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"} | environment
        limited = ["bash", "-c", f'ulimit -t {seconds:.0f}; exec "$@"', "-"]
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", f"@{listed}"]
        return subprocess.run(limited + command, cwd=ROOT, env=environment, capture_output=True, text=True)


def _failure(run: Result) -> str | None:
    """The first test that failed in a run; None where all that are there passed."""
    if run.returncode in (0, NO_TESTS):
        return None
    found = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", run.stdout, re.MULTILINE)
    return found[1] if found else f"exit status {run.returncode}"


class Reach(NamedTuple):
    """What a file of tests does without a fault: seconds it takes, those of each test, who executes which lines."""

    file: str
    seconds: float
    tests: dict[str, float]
    lines: dict[str, dict[int, list[str]]]


def reach(file: str) -> Reach:
    """Run a file of tests without a fault, which it has to pass, and see what it executes."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        kept = str(Path(folder) / "coverage")
        observed = ["--cov", "--cov-context=test", "--cov-report=", "-vv", "--durations=0", "--durations-min=0", file]
        run = _run(observed, LONGEST, COVERAGE_FILE=kept)
        failing = _failure(run)
        if failing:
            sys.exit(f"{failing} fails without a fault")
        data = CoverageData(kept)
        data.read()
        lines = {name.rpartition("/src/")[2]: data.contexts_by_lineno(name) for name in data.measured_files()}
    tests: dict[str, float] = {}
    for seconds, test in re.findall(r"^([\d.]+)s (?:setup|call|teardown) +(.+)$", run.stdout, re.MULTILINE):
        tests[test] = tests.get(test, 0.0) + float(seconds)
    return Reach(file, time.perf_counter() - start, tests, lines)


def order(fault: Fault, source: str, reaches: Iterable[Reach]) -> tuple[list[str], list[Reach]]:
    """The tests to try first, and every file that executes the statement with the fault; the cheapest ones first."""
    lines, imported = statement(source, fault.line)
    module = str(fault.file.relative_to("src"))
    files = [file for file in reaches if not lines.isdisjoint(file.lines.get(module, {}))]
    seconds: dict[str, float] = {}
    for file in files:
        executed = file.lines[module]
        # What an import runs is put down to whichever test came first: those that use the module say more.
        for line in executed if imported else lines & executed.keys():
            tests = {context.rpartition("|")[0] for context in executed[line]} - {""}
            seconds |= {test: file.tests[test] for test in tests}
    cheapest = sorted(seconds, key=lambda test: seconds[test])
    first = [
        test
        for test, spent in zip(cheapest, accumulate(seconds[test] for test in cheapest), strict=True)
        if spent <= FIRST
    ]
    # By file: between two files the compiled programs are dropped.
    return sorted(first, key=lambda test: test.partition("::")[0]), sorted(files, key=lambda file: file.seconds)


def noticed(fault: Fault, reaches: Iterable[Reach]) -> str | None:
    """The first test found to fail with the fault in a copy of the package; None where it survives."""
    source = (ROOT / fault.file).read_text(encoding="utf-8")
    first, files = order(fault, source, reaches)
    faulty = (fault.file, with_fault(source, fault))
    if first:
        run = _run(first, PATIENCE * FIRST, faulty)
        if run.returncode != NOT_FOUND and (failing := _failure(run)):
            return failing
    if not files:
        return None
    return _failure(_run([file.file for file in files], PATIENCE * sum(file.seconds for file in files), faulty))


def main() -> None:
    """Draw, run, report."""
    parser = argparse.ArgumentParser(description="Share of drawn faults that the tests notice.")
    parser.add_argument("rooms", nargs="*", default=sorted(TESTS), metavar="ROOM", help=f"of {', '.join(TESTS)}")
    parser.add_argument("--count", type=int, default=50, help="faults drawn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--least", type=float, default=0.0, help="percent that have to be noticed")
    arguments = parser.parse_args()
    pool = [(fault, room) for room in arguments.rooms for fault in faults(room)]
    drawn = random.Random(arguments.seed).sample(pool, min(arguments.count, len(pool)))
    print(f"{len(drawn)} of {len(pool)} faults", flush=True)
    begun = time.perf_counter()
    with ThreadPoolExecutor(arguments.workers) as workers:
        tests = {room: _files(room) for room in sorted({room for _, room in drawn})}
        reaches = {file.file: file for file in workers.map(reach, sorted(set().union(*tests.values())))}
        print(f"{len(reaches)} files of tests without a fault: {time.perf_counter() - begun:.0f} s", flush=True)

        def judged(item: tuple[Fault, str]) -> tuple[str | None, float]:
            start = time.perf_counter()
            return noticed(item[0], [reaches[file] for file in tests[item[1]]]), time.perf_counter() - start

        verdicts = []
        for (fault, room), (test, seconds) in zip(drawn, workers.map(judged, drawn), strict=True):
            verdicts.append((room, test is not None))
            print(f"{fault.file}:{fault.line} {fault.kind}: {test or 'SURVIVED'} ({seconds:.0f} s)", flush=True)
    for room in arguments.rooms:
        own = [found for name, found in verdicts if name == room]
        if own:
            print(f"{room}: {sum(own)} of {len(own)}")
    minutes = (time.perf_counter() - begun) / 60
    share = sum(found for _, found in verdicts) / len(verdicts)
    print(
        f"noticed: {sum(found for _, found in verdicts)} of {len(verdicts)}, {100 * share:.1f} %, in {minutes:.0f} min"
    )
    sys.exit(100 * share < arguments.least)


if __name__ == "__main__":
    main()
