"""From the tables of a file to the objects that they name."""

import difflib
import re
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax

from perfcontrol._checks import InputError
from perfcontrol.files.arrays import array_of, kind_of
from perfcontrol.files.changing import value_of
from perfcontrol.files.document import Document, Place, read_document, spelt
from perfcontrol.files.registry import (
    IN_PYTHON_ONLY,
    ROWS,
    Argument,
    DesignedGain,
    Row,
    parts_of,
    plain_type,
    rows_giving,
)
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import AbstractSolver
from perfcontrol.solvers.solve import check_feasible
from perfcontrol.systems import design_gain

LONGEST = 1_000_000  # horizon, where it is finite: what is longer is a slip, or has no use
LARGEST = 10_000_000  # free parameters
SCALARS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


@dataclass(frozen=True)
class Plan:
    """What a file asks for: a problem, and how `perfcontrol solve` solves it.

    Attributes:
        problem: the problem.
        solver: the method; None where the file names none.
        M0: where it starts; None for the solver's own start.
        seed: of all randomness.
    """

    problem: PerformativeProblem
    solver: AbstractSolver | None = None
    M0: Any = None
    seed: int = 0


PLAN = {
    "experiment": Argument("experiment", (PerformativeProblem,), False, None, "A ready problem, in place of all else."),
    "solver": Argument("solver", (AbstractSolver,), False, None, "How `perfcontrol solve` solves it."),
    "M0": Argument("M0", (Any,), False, None, "Where the solver starts: free parameters, (memory, input, state)."),
    "seed": Argument("seed", (int,), False, 0, "Of all randomness."),
}


def read_plan(path: Path) -> Plan:
    """The plan of a TOML file; raises InputError naming file, line and key."""
    return plan_of(read_document(path))


def plan_of(document: Document) -> Plan:
    """The plan that a document holds."""
    place, tables = Place(document), document.tables
    problem_row = ROWS["PerformativeProblem"]
    if "experiment" in tables:
        experiments = [row for row in rows_giving(PerformativeProblem) if row is not problem_row]
        _check_keys(tables, PLAN, place, "a file with an experiment")
        problem = _part(tables["experiment"], experiments, place / "experiment")
    else:
        _check_keys(tables, {**problem_row.arguments, **PLAN}, place, "a problem")
        given = {name: value for name, value in tables.items() if name not in PLAN}
        problem = _built(problem_row, given, place)
    read = {name: _value(tables[name], argument, place / name) for name, argument in PLAN.items() if name in tables}
    seed = read.get("seed", 0)
    if not 0 <= seed < 2**32:
        raise (place / "seed").fault(str(seed), "lie between 0 and 2^32 - 1", "Write for example seed = 0.")
    M0 = read.get("M0")
    if M0 is not None:
        with _Located(place, {"M0"}):
            M0 = problem.check_policy("M0", M0)
            check_feasible("M0", problem, M0)
    solver = read.get("solver")
    if solver is not None:
        with _Located(place / "solver", set(ROWS[type(solver).__name__].arguments)):
            solver.on(problem, jax.random.key(seed)).check(problem)
    return Plan(problem, solver, M0, seed)


def part_from(text: str, kind: type, option: str) -> Any:
    """An ingredient from a name or an inline table, as an option of a command line gives it."""
    document = Document(Path(option), "", {option: value_of(text)})
    return _part(document.tables[option], rows_giving(kind), Place(document, (option,)))


def _value(value: Any, argument: Argument, place: Place) -> Any:
    """What a key holds, as its argument takes it."""
    kinds, parts = argument.alternatives, parts_of(argument)
    if parts and (isinstance(value, dict) or (isinstance(value, str) and not _is_file(value, kinds))):
        named = [name for kind in kinds if typing.get_origin(kind) is Literal for name in typing.get_args(kind)]
        if value not in named:
            return _part(value, parts, place, named)
    for kind in kinds:
        if typing.get_origin(kind) is list and isinstance(value, list):
            member = Argument("", typing.get_args(kind), True, None, "")
            return [_value(item, member, place / i) for i, item in enumerate(value)]
        if kind in SCALARS and _is(value, kind):
            return _sized(value, place)
    if Any in kinds:
        return array_of(value, place)
    for kind in kinds:
        if typing.get_origin(kind) is Literal:
            names = typing.get_args(kind)
            if value in names and not isinstance(value, bool):
                return value
            raise place.fault(kind_of(value), f"be one of {_listed(names)}", _suggest(value, names, "Choose one."))
    scalars = [kind for kind in kinds if kind in SCALARS and not (kind is int and float in kinds)]
    required = " or ".join([*(SCALARS[kind] for kind in scalars), *(["a table"] if parts else [])])
    raise place.fault(kind_of(value), f"be {required or 'a list'}", _example(argument))


def _is(value: Any, kind: type) -> bool:
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


def _is_file(value: str, kinds: Iterable[Any]) -> bool:
    return Any in kinds and ("." in value or "/" in value)


def _sized(value: Any, place: Place) -> Any:
    if isinstance(value, int | float) and not isinstance(value, bool):
        if value != value:
            raise place.fault("nan", "be a number", "Replace what is missing.")
        if isinstance(value, int) and abs(value) > 2**53:
            raise place.fault(
                f"a whole number of {len(str(abs(value)))} digits", "be below 2^53", "Write a smaller one."
            )
    return value


def _part(value: Any, rows: list[Row], place: Place, named: list[str] | None = None) -> Any:
    """The object that a table names by its `type`; a text is a type without arguments."""
    table = {"type": value} if isinstance(value, str) else value
    names = [row.name for row in rows]
    if not isinstance(table, dict):
        raise place.fault(kind_of(value), "be a table with a type", f"Write {{ type = {names[0]!r}, ... }}.")
    name = table.get("type", plain_type(rows))
    where = place if isinstance(value, str) else place / "type"
    if name is None:
        raise place.fault("no type", "have a type", f"Types here: {_listed(names)}.")
    if not isinstance(name, str) or name not in names:
        if isinstance(name, str) and (reason := IN_PYTHON_ONLY.get(name.removeprefix("pc."))):
            raise where.fault(f"pc.{name.removeprefix('pc.')}", "be a type that a file can hold", f"It {reason}.")
        takes = [*(named or []), *names]
        raise where.fault(kind_of(name), f"be one of {_listed(takes)}", _suggest(name, takes, "Choose one of these."))
    return _built(ROWS[name], {key: item for key, item in table.items() if key != "type"}, place)


def _built(row: Row, table: dict[str, Any], place: Place) -> Any:
    """The row's constructor called with what a table holds."""
    arguments = row.arguments
    _check_keys(table, arguments, place, row.name)
    missing = [argument for argument in arguments.values() if argument.required and argument.name not in table]
    given = {name: _value(value, arguments[name], place / name) for name, value in table.items()}
    if missing:
        first, *others = missing
        more = f", nor {_listed([argument.name for argument in others])}" if others else ""
        owner = "a problem" if row.gives is PerformativeProblem else row.name
        raise place.wrong(f"{owner} needs the key `{first.name}`, which is not given{more}. {_example(first)}")
    if row.gives is PerformativeProblem:
        _check_size(given, place)
        if isinstance(weights := given.get("gain"), DesignedGain):
            with _Located(place / "gain", {"Q", "R"}):
                given["gain"] = design_gain(given["system"], Q=weights.Q, R=weights.R)
    with _Located(place, set(arguments)):
        return row.build(**given)


def _check_keys(table: dict[str, Any] | Any, known: Iterable[str], place: Place, owner: str) -> None:
    known = list(known)
    for name in table:
        if name not in known:
            takes = f"It takes {_listed(known)}." if known else "It takes none beside type."
            raise (place / name).wrong(
                f"`{spelt((*place.key, name))}` is no key of {owner}. {_suggest(name, known, takes)}"
            )


def _suggest(name: Any, known: Iterable[str], otherwise: str) -> str:
    """The nearest of the known names, or what is said otherwise."""
    folded = {word.casefold(): word for word in known}
    near = difflib.get_close_matches(str(name).casefold().removeprefix("pc."), folded, 1, 0.5)
    return f"Did you mean {folded[near[0]]!r}?" if near else otherwise


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)


def _example(argument: Argument) -> str:
    """How to write an argument."""
    parts = [row.name for row in parts_of(argument)]
    if parts and Any not in argument.alternatives:
        return f"Write a table [{argument.name}] with a type, which is one of {_listed(parts)}."
    return f"{argument.name}: {argument.about}" if argument.about else "Write a value."


def _check_size(given: dict[str, Any], place: Place) -> None:
    """Refuse sizes that no memory holds, before anything is made of them."""
    for name, largest in (("horizon", LONGEST), ("memory", LARGEST)):
        value = given.get(name)
        if isinstance(value, int | float) and value > largest and value != float("inf"):
            raise (place / name).fault(f"{value:g}", f"be at most {largest:g}", "Write inf for the long run.")


class _Located:
    """Errors of constructors, told with the place of the argument that they name."""

    def __init__(self, place: Place, arguments: set[str]):
        self.place, self.arguments = place, arguments

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if isinstance(error, InputError):
            match = re.match(r"`([^`]+)` ", str(error))
            where = self._find(match[1]) if match else None
            if match is None or where is None:
                raise self.place.wrong(str(error)) from None
            raise where.wrong(f"`{'.'.join(map(str, where.key))}` {str(error)[match.end() :]}") from None
        if isinstance(error, MemoryError | OverflowError) or type(error).__name__ == "XlaRuntimeError":
            why = str(error).split("\n")[0][:120] or type(error).__name__
            raise self.place.wrong(f"the numbers are too large ({why}). Use smaller ones.") from None

    def _find(self, argument: str) -> Place | None:
        """Where an argument stands: here, or deeper in the one table that has it."""
        name = argument.partition("[")[0]
        if name in self.arguments:
            return self.place / name
        inside: Any = self.place.document.tables
        for part in self.place.key:
            inside = inside[part]
        found = list(_keys(inside, name, self.place))
        if not found and name in self.place.document.tables:  # a solver that does not take the problem's cost
            return Place(self.place.document, (name,))
        return found[0] if len(found) == 1 else None


def _keys(table: Any, name: str, place: Place) -> Iterable[Place]:
    for key, value in table.items() if isinstance(table, dict) else enumerate(table):
        if key == name:
            yield place / key
        if isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], dict)):
            yield from _keys(value, name, place / key)
