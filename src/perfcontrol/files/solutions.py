"""Solutions on disk: arrays as NumPy's npz, the rest as JSON inside of it, nothing executable."""

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import fail, is_concrete
from perfcontrol._files import written_whole
from perfcontrol.solvers import Result, Solution

FORMAT = "perfcontrol solution 1"
HEADER = "header.json"
LARGEST = 4 * 2**30  # bytes of all arrays of a file
NAMES = ("success", "running", "diverged", "nonfinite", "undersampled", "not_converged")  # of `Result`


def write_solution(solution: Solution, path: Path) -> None:
    """Write a solution, bit for bit."""
    arrays: dict[str, np.ndarray] = {"M": _array("M", solution.M), "steps": _array("steps", solution.steps)}
    arrays |= {f"stats.{name}": _array(name, value) for name, value in solution.stats.items()}
    codes = np.stack([np.asarray(solution.result == getattr(Result, name)) for name in NAMES]).argmax(axis=0)
    header = {
        "format": FORMAT,
        "results": NAMES,
        "history": _structure(solution.history, "history", arrays),
        "stats": list(solution.stats),
    }
    text = json.dumps(header, allow_nan=False).encode()
    with written_whole(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **{HEADER: np.frombuffer(text, np.uint8), "result": codes, **arrays})


def _structure(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """How nested dicts, tuples and lists of arrays are put together again; the arrays are taken out by name."""
    if value is None:
        return None
    if type(value) is dict and all(isinstance(key, str) for key in value):
        return {"dict": {key: _structure(item, f"{name}.{key}", arrays) for key, item in value.items()}}
    if type(value) in (tuple, list):
        items = [_structure(item, f"{name}.{i}", arrays) for i, item in enumerate(value)]
        return {type(value).__name__: items}
    arrays[name] = _array(name, value)
    return name


def _array(name: str, value: Any) -> np.ndarray:
    if not is_concrete(value):
        raise fail(name, "a traced value", "be known when it is saved", "Save outside of jit and vmap.")
    try:
        array = np.asarray(value)
    except TypeError:  # random keys
        array = np.asarray(None)
    if array.dtype.kind not in "fiub":
        got = f"{type(value).__name__} of {array.dtype}"
        raise fail(name, got, "be an array of real numbers", "Let `record` return arrays, in dicts, lists or tuples.")
    return array


def read_solution(path: Path) -> Solution:
    """The solution that a file holds; raises InputError for any other content."""
    header, arrays = _read(path)
    try:
        code = arrays.pop("result")
        names = [header["results"][i] for i in np.atleast_1d(code).tolist()]
        results = [getattr(Result, name) for name in names if name in NAMES]
        result = results[0] if code.ndim == 0 else jax.tree.map(lambda *each: jnp.stack(each), *results)
        history = _restored(header["history"], arrays)
        stats = {name: _leaf(arrays[f"stats.{name}"]) for name in header["stats"]}
        return Solution(_leaf(arrays["M"]), result, _leaf(arrays["steps"]), history, stats)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise unreadable(path, error) from None


def _restored(structure: Any, arrays: dict[str, np.ndarray]) -> Any:
    if structure is None:
        return None
    if isinstance(structure, str):
        return _leaf(arrays[structure])
    ((kind, items),) = structure.items()
    if kind == "dict":
        return {name: _restored(item, arrays) for name, item in items.items()}
    return {"tuple": tuple, "list": list}[kind](_restored(item, arrays) for item in items)


def _leaf(array: np.ndarray) -> Any:
    """A JAX array where JAX can hold its numbers as they are, else the NumPy array."""
    double = array.dtype.itemsize == 8 and not jax.config.jax_enable_x64  # type: ignore[attr-defined]
    return array if double else jnp.asarray(array)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            size = sum(entry.file_size for entry in file.zip.infolist())
            if size > LARGEST:
                raise ValueError(f"arrays of {size / 2**30:.1f} GiB")
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop(HEADER).tobytes().decode())
        if header["format"] != FORMAT:
            raise KeyError(header["format"])
        return header, arrays
    except FileNotFoundError:
        raise fail("path", f"{path}, which does not exist", "be a file", "Check the path.") from None
    except (
        ValueError, KeyError, TypeError, AttributeError, EOFError, SyntaxError, MemoryError, OverflowError,
        NotImplementedError, RuntimeError, RecursionError, zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip
        raise unreadable(path, error) from None


def unreadable(path: Path, error: Exception) -> Exception:
    """The error about a file with other content."""
    return fail(
        "path", f"{path} ({type(error).__name__}: {error})"[:300], "be a file that pc.save wrote", "Save it again."
    )
