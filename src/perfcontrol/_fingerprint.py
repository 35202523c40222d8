"""A fingerprint of a problem or solver: the same in every process that builds it alike, another where a number differs.

Arrays count by their bytes; functions by module, name, constants, defaults and what they close over, not by their
address. Two functions that differ in their operations alone are taken for the same.
"""

import dataclasses
import functools
import hashlib
import types
from collections.abc import Iterator
from typing import Any

import jax
import jax.dtypes
import jax.numpy as jnp
import numpy as np


def fingerprint(thing: Any) -> str:
    """SHA-256, in hexadecimal digits."""
    digest = hashlib.sha256()
    for word in _words(thing, ()):
        digest.update(len(word).to_bytes(8, "little") + word)
    return digest.hexdigest()


def _words(thing: Any, above: tuple[int, ...]) -> Iterator[bytes]:
    """What tells `thing` from others; `above` are the objects that it is part of, so that a cycle ends."""
    if id(thing) in above:
        yield b"itself"
        return
    inside = (*above, id(thing))
    if thing is None or isinstance(thing, bool | int | float | complex | str | bytes):
        yield f"{type(thing).__name__} {thing!r}".encode()
    elif isinstance(thing, jax.Array) and jnp.issubdtype(thing.dtype, jax.dtypes.prng_key):
        yield from _words(jax.random.key_data(thing), inside)
    elif isinstance(thing, jax.Array | np.ndarray | np.generic):
        array = np.asarray(thing)
        yield f"array {array.dtype.str} {array.shape}".encode()
        yield array.tobytes()
    else:
        parts = _parts(thing)
        yield f"{type(thing).__module__}.{type(thing).__qualname__} of {len(parts)}".encode()
        for part in parts:
            yield from _words(part, inside)


def _parts(thing: Any) -> list[Any]:
    """What an object consists of."""
    if isinstance(thing, tuple | list):
        return list(thing)
    if isinstance(thing, dict):
        return [part for pair in thing.items() for part in pair]
    if isinstance(thing, set | frozenset):
        return sorted(thing, key=repr)
    if isinstance(thing, type | types.ModuleType | types.BuiltinFunctionType | np.ufunc):
        return [getattr(thing, "__module__", None), getattr(thing, "__qualname__", None), thing.__name__]
    if isinstance(thing, types.CodeType):
        return [thing.co_name, thing.co_names, thing.co_consts]
    if isinstance(thing, types.FunctionType):
        cells = [cell.cell_contents for cell in thing.__closure__ or ()]
        return [thing.__module__, thing.__qualname__, thing.__code__, thing.__defaults__, thing.__kwdefaults__, cells]
    if isinstance(thing, types.MethodType):
        return [thing.__func__, thing.__self__]
    if isinstance(thing, functools.partial):
        return [thing.func, thing.args, thing.keywords]
    if hasattr(thing, "__wrapped__"):
        return [thing.__wrapped__]
    if dataclasses.is_dataclass(thing):
        fields = dataclasses.fields(thing)
        return [part for f in fields for part in (f.name, getattr(thing, f.name))]
    return [part for pair in sorted(getattr(thing, "__dict__", {}).items()) for part in pair]
