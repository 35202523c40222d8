"""The state of a controller in one file: arrays as NumPy's npz, the rest as JSON inside of it, nothing executable."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from perfcontrol._array_files import UnreadableError, filled, named, read_arrays, write_arrays
from perfcontrol._checks import fail
from perfcontrol.online.state import ControllerState, Entry, Limits

FORMAT = "perfcontrol controller 1"


def save(state: ControllerState, path: Any, owner: dict[str, str]) -> None:
    """Write the state; `owner` are the fingerprints of what the controller is made of."""
    path = as_path(path)
    for name, array in named(state).items():
        if not _finite(array):
            raise fail(
                "state", f"a number in {name} that is not finite", "be finite to be saved", "Save an earlier state."
            )
    header = {
        "format": FORMAT,
        "owner": owner,
        "limits": None if state.limits is None else state.limits._asdict(),
        "log": [dataclasses.astuple(entry) for entry in state.log],
    }
    write_arrays(path, header, state)


def restore(blank: ControllerState, path: Any, owner: dict[str, str]) -> ControllerState:
    """The state that a file holds, in the form of `blank`."""
    path = as_path(path)
    try:
        header, arrays = read_arrays(path, FORMAT)
        _check_owner(path, header, owner)
        state = filled(blank, arrays)
        for name, array in arrays.items():
            if not _finite(array):
                raise UnreadableError(f"a number in {name} that is not finite")
    except FileNotFoundError as error:
        raise fail("path", f"{path}, which does not exist", "be a file", "Pass one that `save` wrote.") from error
    except UnreadableError as error:
        raise _unreadable(path, str(error)) from error
    try:
        limits = None if header["limits"] is None else Limits(**header["limits"])
        log = tuple(Entry(*entry) for entry in header["log"])
    except (KeyError, TypeError) as error:
        raise _unreadable(path, "a header that is not ours") from error
    return dataclasses.replace(state, limits=limits, log=log)


def as_path(path: Any) -> Path:
    """A path; raises InputError for anything else."""
    if not isinstance(path, str | os.PathLike):
        raise fail("path", type(path).__name__, "be the path of a file", 'Pass for example "plant.npz".')
    return Path(path)


def _check_owner(path: Path, header: dict[str, Any], owner: dict[str, str]) -> None:
    written = header.get("owner")
    if not isinstance(written, dict):
        raise UnreadableError("a header that is not ours")
    for part, value in owner.items():
        if written.get(part) != value:
            required = f"hold the state of a controller with the same {part}"
            raise fail("path", f"{path}, of another {part}", required, "Begin with init(M0=...) to change it.")


def _finite(array: np.ndarray) -> bool:
    return array.dtype.kind in "biu" or (array.dtype.kind == "f" and bool(np.isfinite(array).all()))


def _unreadable(path: Path, what: str) -> Exception:
    return fail("path", f"{path} with {what}", "be a file that `save` wrote", "Restore an earlier file.")
