"""From objects to the tables of a file: the way back of `building`."""

import hashlib
import inspect
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from perfcontrol._checks import fail, is_concrete
from perfcontrol._files import written_whole
from perfcontrol.files.building import Plan
from perfcontrol.files.registry import Argument, Row, row_of
from perfcontrol.policy_maps import ConstantMap
from perfcontrol.solvers.step_sizes import ConstantStep

INLINE = 400  # numbers of an array that is written out; larger ones go into an NPY file beside

_PLAIN = {ConstantMap: "value", ConstantStep: "size"}  # stand for the array that a user passed


def tables_of(plan: Plan) -> dict[str, Any]:
    """A plan as tables; arrays stay NumPy arrays."""
    tables = _table(plan.problem, ())
    del tables["type"]
    if not plan.problem.has_gain:
        tables.pop("gain", None)
    for name, value in (("solver", plan.solver), ("M0", plan.M0), ("seed", plan.seed or None)):
        if value is not None:
            tables[name] = _value(value, (name,))
    return tables


def _table(part: Any, key: tuple[str, ...]) -> dict[str, Any]:
    row = row_of(part)
    if row is None:
        raise _refuse(part, key)
    if any(getattr(part, name, None) is not None for name in row.python):
        raise _refuse(next(getattr(part, name) for name in row.python), (*key, row.python[0]))
    table: dict[str, Any] = {"type": row.name}
    for name, argument in row.arguments.items():
        value = _held(part, row, name)
        if value is not None and not _is_default(value, argument):
            table[name] = _value(value, (*key, name))
    return table


def _held(part: Any, row: Row, name: str) -> Any:
    """What an object was given for an argument."""
    where = row.kept.get(name, name)
    if callable(where):
        return where(part)
    for step in where.split("."):
        part = getattr(part, step, None)
    return part


def _is_default(value: Any, argument: Argument) -> bool:
    """Whether the constructor would take the same when told nothing; only of plain values and parts without keys."""
    if argument.required:
        return False
    if isinstance(value, bool | int | float | str):
        return type(value) is type(argument.default) and value == argument.default
    return False


def _value(value: Any, key: tuple[str, ...]) -> Any:
    if isinstance(value, bool | int | float | str):
        return value
    for kind, held in _PLAIN.items():
        if isinstance(value, kind):
            value = getattr(value, held)
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        if not is_concrete(value):
            raise fail(spelt(key), "a traced value", "be known when it is saved", "Save outside of jit and vmap.")
        return np.asarray(value)
    if isinstance(value, tuple | list):
        return [_value(item, (*key, str(i))) for i, item in enumerate(value)]
    return _table(value, key)


def spelt(key: tuple[str, ...]) -> str:
    """A key with dots."""
    return ".".join(key) or "thing"


def _refuse(part: Any, key: tuple[str, ...]) -> Exception:
    from perfcontrol._printing import public_name

    remedies = {
        "scale": "Use pc.Affine(offset, slope) or pc.Norm(offset, weight), or keep the problem as a Python program.",
        "function": "Use pc.Huber, pc.LogCosh, pc.OneSidedQuadratic or pc.LinearExponential, or keep it in Python.",
        "step_size": "Use a number, pc.InverseStep or pc.PowerStep.",
        "transform": "Leave it out, or keep the solver in Python.",
    }
    same = {"mean": "scale", "probabilities": "scale", "noise": "scale"}
    last = key[-1] if key else ""
    remedy = remedies.get(same.get(last, last), "Use one of the families of the reference, or keep it in Python.")
    got = f"{type(part).__name__}" if inspect.isfunction(part) else public_name(part)
    return fail(spelt(key), f"{got}, which holds Python code", "be made of what a file can hold", remedy)


def write_plan(plan: Plan, path: Path) -> None:
    """Write a plan as TOML, large arrays beside it, which come first: a file names nothing that is not there."""
    tables, beside = tables_of(plan), {}
    text = toml_text(tables, path.stem, beside)
    for name, array in beside.items():
        if not (path.parent / name).is_file():
            with written_whole(path.parent / name) as temporary, temporary.open("wb") as file:
                np.save(file, array, allow_pickle=False)
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def toml_text(tables: Mapping[str, Any], stem: str, beside: dict[str, np.ndarray]) -> str:
    """Tables as TOML; arrays that are too large to be written out are put into `beside`, by the name of their file."""
    lines = list(_lines(tables, (), stem, beside))
    return "\n".join(lines).strip("\n") + "\n"


def _lines(table: Mapping[str, Any], key: tuple[str, ...], stem: str, beside: dict[str, np.ndarray]) -> Iterator[str]:
    inner = {name: value for name, value in table.items() if isinstance(value, Mapping) or _is_tables(value)}
    for name, value in table.items():
        if name not in inner:
            yield f"{name} = {_literal(value, (*key, name), stem, beside)}"
    for name, value in inner.items():
        path = (*key, name)
        for item in [value] if isinstance(value, Mapping) else value:
            yield ""
            yield f"[{'.'.join(path)}]" if isinstance(value, Mapping) else f"[[{'.'.join(path)}]]"
            yield from _lines(item, path, stem, beside)


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, Mapping) for item in value)


def _literal(value: Any, key: tuple[str, ...], stem: str, beside: dict[str, np.ndarray]) -> str:
    if isinstance(value, np.ndarray):
        if value.size > INLINE:
            digest = hashlib.sha256(value.tobytes() + str(value.shape).encode()).hexdigest()[:12]
            name = f"{stem}.{'.'.join(key)}.{digest}.npy"
            beside[name] = value
            return json.dumps(name)
        return _rows(value.tolist(), "")
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{name} = {_literal(item, key, stem, beside)}' for name, item in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(_literal(item, key, stem, beside) for item in value)}]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _rows(value: Any, indent: str) -> str:
    """Nested lists of numbers, a row a line."""
    if not isinstance(value, list):
        return str(value).lower() if isinstance(value, bool) else repr(value)
    if not value or not isinstance(value[0], list):
        return f"[{', '.join(_rows(item, indent) for item in value)}]"
    inside = "".join(f"{indent}  {_rows(item, indent + '  ')},\n" for item in value)
    return f"[\n{inside}{indent}]"
