"""A pytree of arrays and a JSON header in one file: NumPy's npz, whole or not at all, nothing executable."""

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.dtypes
import jax.numpy as jnp
import numpy as np

from perfcontrol._files import written_whole

HEADER = "header.json"


class UnreadableError(Exception):
    """A file whose content is not what was written; the text says what stands there instead."""


def write_arrays(path: Path, header: dict[str, Any], tree: Any) -> None:
    """Write the header, whose `format` says whose file it is, and the arrays of a tree."""
    text = np.frombuffer(json.dumps(header, allow_nan=False).encode(), np.uint8)
    arrays: dict[str, Any] = {HEADER: text, **named(tree)}
    with written_whole(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # no keyword more: NumPy 2.0 takes each for an array


def read_arrays(path: Path, form: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file of this format; raises FileNotFoundError, or UnreadableError for other content."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if any(entry.file_size > entry.compress_size for entry in file.zip.infolist()):
                raise ValueError("compressed, as nothing that is written here")  # what unpacks may fill the memory
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop(HEADER).tobytes().decode())
        if header["format"] != form:
            raise KeyError(form)
        return header, arrays
    except FileNotFoundError:
        raise
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        EOFError,
        MemoryError,
        OverflowError,
        RuntimeError,  # encrypted, of an unknown compression, JSON nested too deeply
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise UnreadableError(f"no such content ({type(error).__name__})") from error


def named(tree: Any) -> dict[str, np.ndarray]:
    """The arrays of a tree by their place in it; random keys as the words that they consist of."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, eqx.is_array_like))
    words = [(jax.tree_util.keystr(place, simple=True, separator="."), _words(leaf)) for place, leaf in leaves]
    return {name or "value": np.asarray(leaf) for name, leaf in words}


def filled(blank: Any, arrays: dict[str, np.ndarray]) -> Any:
    """`blank` with these arrays in the place of its own; raises UnreadableError where they do not fit."""
    changing, fixed = eqx.partition(blank, eqx.is_array_like)
    leaves, structure = jax.tree.flatten(changing)
    names = named(blank)
    read = [
        _fitting(name, arrays.get(name), own, leaf) for (name, own), leaf in zip(names.items(), leaves, strict=True)
    ]
    if len(arrays) != len(names):
        raise UnreadableError("more arrays than there should be")
    return eqx.combine(jax.tree.unflatten(structure, read), fixed)


def _fitting(name: str, array: np.ndarray | None, like: np.ndarray, leaf: Any) -> Any:
    """The array in the kind of `leaf`, of which `like` are the words."""
    if array is None:
        raise UnreadableError(f"no {name}")
    if array.shape != like.shape or array.dtype != like.dtype:
        got, required = (f"{a.dtype.name} of shape {a.shape}" for a in (array, like))
        raise UnreadableError(f"{name} as {got} instead of {required}")
    if _is_key(leaf):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(leaf))
    return array


def _words(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
