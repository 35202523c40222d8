"""The state of a controller in one file: arrays as NumPy's npz, the rest as JSON inside of it, nothing executable."""

import dataclasses
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from perfcontrol._checks import fail
from perfcontrol._files import written_whole
from perfcontrol.online.state import ControllerState, Entry, Limits

FORMAT = "perfcontrol controller 1"
HEADER = "header.json"


def save(state: ControllerState, path: Any, owner: dict[str, str]) -> None:
    """Write the state; `owner` are the fingerprints of what the controller is made of."""
    path = as_path(path)
    arrays = dict(_named(state))
    for name, array in arrays.items():
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
    text = json.dumps(header, allow_nan=False)
    with written_whole(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **{HEADER: np.frombuffer(text.encode(), np.uint8)}, **arrays)


def restore(blank: ControllerState, path: Any, owner: dict[str, str]) -> ControllerState:
    """The state that a file holds, in the form of `blank`."""
    path = as_path(path)
    header, arrays = _read(path)
    for part, value in owner.items():
        if header["owner"].get(part) != value:
            required = f"hold the state of a controller with the same {part}"
            raise fail("path", f"{path}, of another {part}", required, "Begin with init(M0=...) to change it.")
    names = [name for name, _ in _named(blank)]
    leaves = [_checked(path, name, arrays.get(name), leaf) for name, leaf in _named(blank)]
    if len(arrays) != len(names):
        raise _unreadable(path, "more arrays than the state has")
    state = jax.tree.unflatten(jax.tree.structure(blank), leaves)
    try:
        limits = None if header["limits"] is None else Limits(**header["limits"])
        log = tuple(Entry(*entry) for entry in header["log"])
    except TypeError as error:
        raise _unreadable(path, "a header that is not ours") from error
    return dataclasses.replace(state, limits=limits, log=log)


def as_path(path: Any) -> Path:
    """A path; raises InputError for anything else."""
    if not isinstance(path, str | os.PathLike):
        raise fail("path", type(path).__name__, "be the path of a file", 'Pass for example "plant.npz".')
    return Path(path)


def _named(state: ControllerState) -> list[tuple[str, np.ndarray]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(state, eqx.is_array_like))
    return [(jax.tree_util.keystr(path).lstrip("."), np.asarray(leaf)) for path, leaf in leaves]


def _finite(array: np.ndarray) -> bool:
    return array.dtype.kind in "biu" or (array.dtype.kind == "f" and bool(np.isfinite(array).all()))


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop(HEADER).tobytes().decode())
        if header["format"] != FORMAT or not isinstance(header["owner"], dict):
            raise KeyError(FORMAT)
        return header, arrays
    except FileNotFoundError as error:
        raise fail("path", f"{path}, which does not exist", "be a file", "Pass one that `save` wrote.") from error
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise _unreadable(path, f"no such content ({type(error).__name__})") from error


def _checked(path: Path, name: str, array: np.ndarray | None, like: np.ndarray) -> np.ndarray:
    if array is None:
        raise _unreadable(path, f"no {name}")
    if array.shape != like.shape or array.dtype != like.dtype:
        got, required = (f"{a.dtype.name} of shape {a.shape}" for a in (array, like))
        raise _unreadable(path, f"{name} as {got} instead of {required}")
    if not _finite(array):
        raise _unreadable(path, f"a number in {name} that is not finite")
    return array


def _unreadable(path: Path, what: str) -> Exception:
    return fail("path", f"{path} with {what}", "be a file that `save` wrote", "Restore an earlier file.")
