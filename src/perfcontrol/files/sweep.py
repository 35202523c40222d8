"""A grid of changed problems, solved point by point into a folder that can be filled in several goes."""

import itertools
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from perfcontrol._checks import fail
from perfcontrol.files.arrays import SUFFIXES
from perfcontrol.files.building import Plan, plan_of
from perfcontrol.files.changing import changed_at, value_of
from perfcontrol.files.document import Document, read_document, read_text
from perfcontrol.files.run import PROBLEM, begin_record
from perfcontrol.files.solutions import read_solution

POINTS = "points"
MOST = 100_000  # points of a grid

_RANGE = re.compile(r"\s*([^:,\s]+)\s*:\s*([^:,\s]+)\s*:\s*(\d+)\s*")


def axis_of(text: str) -> tuple[str, list[Any]]:
    """A key and its values, from `key=1,2,3`, or `key=0:1:11` for eleven numbers from 0 to 1."""
    key, equals, values = text.partition("=")
    if not equals or not key.strip() or not values.strip():
        raise fail("--vary", repr(text), "be key=value,value,...", "Write for example --vary noise.high=0.5,1,2.")
    ends = _RANGE.fullmatch(values)
    try:
        first, last, count = (float(ends[1]), float(ends[2]), int(ends[3])) if ends else (0.0, 0.0, 0)
    except ValueError:
        ends, first, last, count = None, 0.0, 0.0, 0
    if ends and not 2 <= count <= MOST:
        raise fail("--vary", repr(text), f"have 2 to {MOST} numbers", "Write for example key=0:1:11.")
    if ends:
        return key.strip(), np.linspace(first, last, count).tolist()
    listed = value_of(f"[{values}]")
    if not isinstance(listed, list):  # texts without quotation marks
        listed = [value_of(part.strip()) for part in values.split(",")]
    if any(json.dumps(a) == json.dumps(b) for a, b in itertools.combinations(listed, 2)):
        raise fail("--vary", repr(text), "give every value once", "Remove the second one.")
    return key.strip(), listed


def begin_sweep(folder: Path, document: Document, axes: dict[str, list[Any]], **settings: Any) -> None:
    """Copy the problem, with the files beside it that it names, and record what is to be done."""
    for name in sorted(_named_files(document.tables, document.folder)):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(document.folder / name, target)
    (folder / PROBLEM).write_text(document.text, encoding="utf-8")
    (folder / POINTS).mkdir()
    begin_record(folder, "sweep", axes=axes, **settings)


def _named_files(value: Any, folder: Path) -> Iterator[str]:
    if isinstance(value, str) and value.lower().endswith(SUFFIXES):
        inside = (folder / value).resolve().is_relative_to(folder.resolve())
        if inside and (folder / value).is_file():  # a text may end so and be no file: a name of a signal
            yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _named_files(item, folder)


def points_of(axes: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """The grid, the last key running fastest."""
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def plan_at(document: Document, point: dict[str, Any]) -> Plan:
    """The plan with the keys of a point set."""
    return plan_of(changed_at(document, point))


def read_sweep(folder: Path, record: dict[str, Any]) -> Any:
    """What is finished of a sweep, as an xarray Dataset over the grid: results of every point, and policies where all
    have one shape."""
    import xarray

    axes: dict[str, list[Any]] = record["axes"]
    shape = tuple(len(values) for values in axes.values())
    rows = {number: row for number, row in finished(folder)}
    data: dict[str, Any] = {}
    columns = dict.fromkeys(name for row in rows.values() for name in row["numbers"])
    for name in columns:
        values = [rows[i]["numbers"].get(name) if i in rows else None for i in range(int(np.prod(shape)))]
        numbers = np.array([np.nan if value is None else value for value in values], dtype=float)
        data[name] = (tuple(axes), numbers.reshape(shape))
    policies = {i: np.asarray(read_solution(folder / POINTS / f"{i:06d}.npz").M) for i in rows}
    if len({policy.shape for policy in policies.values()}) == 1:
        inner = next(iter(policies.values())).shape
        stacked = np.full((int(np.prod(shape)), *inner), np.nan)
        for i, policy in policies.items():
            stacked[i] = policy
        data["policy"] = ((*axes, "lag", "input", "state"), stacked.reshape(*shape, *inner))
    coordinates = {
        key: [value if isinstance(value, int | float | str) else json.dumps(value) for value in values]
        for key, values in axes.items()
    }
    attributes = {"finished": len(rows), "points": int(np.prod(shape))}
    return xarray.Dataset(data, coords=coordinates, attrs=attributes)


def finished(folder: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Number and results of the points that are finished."""
    for path in sorted((folder / POINTS).glob("[0-9]*.json")):
        yield int(path.stem), json.loads(read_text(path, 2**20, ""))


def base_of(folder: Path) -> Document:
    """The problem that a sweep changes."""
    return read_document(folder / PROBLEM)
