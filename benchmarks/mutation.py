"""`python -m benchmarks.mutation [--count N] [--seed S] [ROOM ...]`: would the tests notice if the code were wrong?

Draws small faults (a sign, a comparison, a constant, a factor) all over the rooms, each in a copy of the package, and
runs the tests of that room until the first failure. Prints the share of faults that were noticed and every one that
was not: some of those change nothing that anybody could see, each is worth a look. Fails where the share is below
`--least` percent.
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
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "perfcontrol"
TESTS = {  # the tests of a room, those that fail soonest first
    "evaluate": ["tests/evaluate", "tests/response", "tests/test_properties.py"],
    "response": ["tests/response", "tests/solvers"],
    "solvers": ["tests/solvers"],
    "sets": ["tests/sets", "tests/response"],
    "perturbations": ["tests/perturbations", "tests/evaluate"],
    "policy_maps": ["tests/test_policy_maps.py", "tests/perturbations"],
    "random_vectors": ["tests/test_random_vectors.py"],
    "costs": ["tests/costs", "tests/evaluate"],
    "theory": ["tests/theory"],
}
PATIENCE = 1800  # seconds of a core after which a fault counts as noticed: it has made something endless
MANY = 50  # of so many samples, steps or rows one more makes no difference
SWAPS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip


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


def _tests(file: Path, room: str) -> list[str]:
    """The tests of the room, those named after the file first."""
    folders = [ROOT / name for name in TESTS[room]]
    near = [path for folder in folders for path in sorted(folder.rglob(f"test_{file.stem}.py"))]
    return [*map(str, near), *TESTS[room]]


def _failure(room: str, file: Path, source: str | None) -> str | None:
    """The first test of the room that fails with `source` in place of the file; None where all pass."""
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "src" / "perfcontrol"
        shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
        if source is not None:
            (Path(folder) / file).write_text(source, encoding="utf-8")
        environment = os.environ | {"PYTHONPATH": str(package.parent), "PYTHONDONTWRITEBYTECODE": "1"}
        limited = ["bash", "-c", f'ulimit -t {PATIENCE}; exec "$@"', "-"]
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *_tests(file, room)]
        run = subprocess.run(limited + command, cwd=ROOT, env=environment, capture_output=True, text=True)
        if run.returncode == 0:
            return None
        found = re.search(r"^(?:FAILED|ERROR) (\S+)", run.stdout, re.MULTILINE)
        return found[1] if found else f"exit status {run.returncode}"


def noticed(fault: Fault, room: str) -> str | None:
    """The test of the room that fails with the fault in a copy of the package; None where it survives."""
    source = (ROOT / fault.file).read_text(encoding="utf-8")
    return _failure(room, fault.file, with_fault(source, fault))


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
    with ThreadPoolExecutor(arguments.workers) as workers:
        rooms = sorted({room for _, room in drawn})
        for room, failing in zip(rooms, workers.map(lambda room: _failure(room, Path(), None), rooms), strict=True):
            if failing:
                sys.exit(f"{room}: {failing} fails without a fault")
        verdicts = []
        for (fault, room), test in zip(drawn, workers.map(lambda item: noticed(*item), drawn), strict=True):
            verdicts.append((room, test is not None))
            print(f"{fault.file}:{fault.line} {fault.kind}: {test or 'SURVIVED'}", flush=True)
    for room in arguments.rooms:
        own = [found for name, found in verdicts if name == room]
        if own:
            print(f"{room}: {sum(own)} of {len(own)}")
    share = sum(found for _, found in verdicts) / len(verdicts)
    print(f"noticed: {sum(found for _, found in verdicts)} of {len(verdicts)}, {100 * share:.1f} %")
    sys.exit(100 * share < arguments.least)


if __name__ == "__main__":
    main()
