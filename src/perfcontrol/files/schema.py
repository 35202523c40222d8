"""The JSON schema of a problem file, from the rows that read it."""

import typing
from typing import Any, Literal

from perfcontrol.files.building import PLAN
from perfcontrol.files.registry import ROWS, Argument, Row, parts_of, plain_type, rows_giving
from perfcontrol.problem import PerformativeProblem

_SIMPLE: dict[Any, dict[str, Any]] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
    Any: {"$ref": "#/$defs/array"},
}


def schema() -> dict[str, Any]:
    """The schema, draft 7, which editors know."""
    array = {
        "description": "A number, nested lists of numbers, or the name of a CSV or NPY file beside this one.",
        "anyOf": [
            {"type": ["number", "boolean"]},
            {"type": "array", "items": {"$ref": "#/$defs/array"}},
            {"type": "string", "pattern": r"\.([cC][sS][vV]|[nN][pP][yY])$"},
        ],
    }
    problem = ROWS["PerformativeProblem"].arguments
    tables = {name: row for name, row in ROWS.items() if row.build is not PerformativeProblem}
    everywhere = [argument for row in ROWS.values() for argument in row.arguments.values()]
    without_type = {plain_type(parts_of(argument)) for argument in everywhere if parts_of(argument)}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "A performative control problem",
        "type": "object",
        "properties": {name: _argument(argument) for name, argument in {**problem, **PLAN}.items()},
        "additionalProperties": False,
        "oneOf": [
            {"required": [name for name, argument in problem.items() if argument.required]},
            {"required": ["experiment"], "properties": dict.fromkeys(problem, False)},
        ],
        "$defs": {"array": array, **{name: _table(row, without_type) for name, row in tables.items()}},
    }


def _table(row: Row, without_type: set[str | None]) -> dict[str, Any]:
    arguments = {name: _argument(argument) for name, argument in row.arguments.items()}
    needed = [name for name, argument in row.arguments.items() if argument.required]
    table = {
        "type": "object",
        "description": " ".join((row.build.__doc__ or "").split("\n\n")[0].split()),
        "properties": {"type": {"const": row.name}, **arguments},
        "required": needed if row.name in without_type else ["type", *needed],
        "additionalProperties": False,
    }
    return table if needed else {"anyOf": [table, {"const": row.name}]}


def _argument(argument: Argument) -> dict[str, Any]:
    choices: list[dict[str, Any]] = []
    for kind in argument.alternatives:
        choices += _choices(kind)
    held = choices[0] if len(choices) == 1 else {"anyOf": choices}
    return {**held, "description": argument.about} if argument.about else held


def _choices(kind: Any) -> list[dict[str, Any]]:
    if kind in _SIMPLE:
        return [_SIMPLE[kind]]
    if typing.get_origin(kind) is Literal:
        return [{"enum": list(typing.get_args(kind))}]
    if typing.get_origin(kind) is list:
        (inner,) = typing.get_args(kind)
        choices = _choices(inner)
        return [{"type": "array", "items": choices[0] if len(choices) == 1 else {"anyOf": choices}}]
    rows = [row for row in rows_giving(kind) if row.build is not PerformativeProblem]
    return [{"$ref": f"#/$defs/{row.name}"} for row in rows]
