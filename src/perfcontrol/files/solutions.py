"""Solutions on disk: arrays as NumPy's npz, the rest as JSON inside of it, nothing executable."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._array_files import UnreadableError, read_arrays, write_arrays
from perfcontrol._checks import fail, is_concrete
from perfcontrol.solvers import Solution
from perfcontrol.solvers.result import MEMBERS

FORMAT = "perfcontrol solution 1"


def write_solution(solution: Solution, path: Path) -> None:
    """Write a solution, bit for bit."""
    arrays: dict[str, np.ndarray] = {"M": _array("M", solution.M), "steps": _array("steps", solution.steps)}
    arrays |= {f"stats.{name}": _array(name, value) for name, value in solution.stats.items()}
    codes = np.stack([np.asarray(solution.result == member) for member in MEMBERS.values()]).argmax(axis=0)
    header = {
        "format": FORMAT,
        "results": list(MEMBERS),
        "history": _structure(solution.history, "history", arrays),
        "stats": list(solution.stats),
    }
    write_arrays(path, header, {"result": codes, **arrays})


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
    try:
        header, arrays = read_arrays(path, FORMAT)
        code = arrays["result"]
        results = [MEMBERS[header["results"][i]] for i in np.atleast_1d(code).tolist()]
        result = results[0] if code.ndim == 0 else jax.tree.map(lambda *each: jnp.stack(each), *results)
        stats = {name: _leaf(arrays[f"stats.{name}"]) for name in header["stats"]}
        history = _restored(header["history"], arrays)
        return Solution(_leaf(arrays["M"]), result, _leaf(arrays["steps"]), history, stats)
    except FileNotFoundError:
        raise fail(
            "path", f"{path}, which does not exist", "be a file", "Name a file that pc.save has written."
        ) from None
    except (UnreadableError, KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise fail("path", f"{path} with {error}"[:300], "be a solution that pc.save wrote", "Save it again.") from None


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
