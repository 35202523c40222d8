"""`python -m benchmarks.mutation [--count N] [--seed S] [ROOM ...]`: would the tests notice if the code were wrong?

Draws small faults (a sign, a comparison, a constant, a factor) all over the rooms, each in a copy of the package, and
runs the tests of that room until the first failure. Prints the share of faults that were noticed and every one that
was not: some of those change nothing that anybody could see, each is worth a look.
"""

import argparse
import ast
import copy
import os
import random
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
PATIENCE = 600  # seconds after which a fault counts as noticed: it has made something endless
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
    """The nodes that compute: no annotations, no docstrings, no messages of errors."""
    skipped: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.JoinedStr):
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
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
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


def noticed(fault: Fault, room: str) -> bool:
    """Whether the tests of the room fail with the fault in a copy of the package."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "src"
        shutil.copytree(PACKAGE, source / "perfcontrol", ignore=shutil.ignore_patterns("__pycache__"))
        file = Path(folder) / fault.file
        file.write_text(with_fault(file.read_text(encoding="utf-8"), fault), encoding="utf-8")
        environment = os.environ | {"PYTHONPATH": str(source), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *TESTS[room]]
        try:
            run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            return True
        return run.returncode != 0


def main() -> None:
    """Draw, run, report."""
    parser = argparse.ArgumentParser(description="Share of drawn faults that the tests notice.")
    parser.add_argument("rooms", nargs="*", default=sorted(TESTS), metavar="ROOM", help=f"of {', '.join(TESTS)}")
    parser.add_argument("--count", type=int, default=50, help="faults drawn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    pool = [(fault, room) for room in arguments.rooms for fault in faults(room)]
    drawn = random.Random(arguments.seed).sample(pool, min(arguments.count, len(pool)))
    print(f"{len(drawn)} of {len(pool)} faults", flush=True)
    with ThreadPoolExecutor(arguments.workers) as workers:
        verdicts = []
        for (fault, room), found in zip(drawn, workers.map(lambda item: noticed(*item), drawn), strict=True):
            verdicts.append((room, found))
            print(f"{'noticed ' if found else 'SURVIVED'} {fault.file}:{fault.line} {fault.kind}", flush=True)
    for room in arguments.rooms:
        own = [found for name, found in verdicts if name == room]
        if own:
            print(f"{room}: {sum(own)} of {len(own)}")
    print(f"noticed: {sum(found for _, found in verdicts)} of {len(verdicts)}")


if __name__ == "__main__":
    main()
