"""Theory works in double precision, whatever the precision of the problem: a proof has no room for rounding in 1e-7."""

import functools
import importlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

P = ParamSpec("P")
R = TypeVar("R")


def double_precision() -> AbstractContextManager[Any]:
    """Where JAX knows float64, on this thread only; what the user has set stays as it is."""
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(True)
    # its place before JAX 0.8
    return importlib.import_module("jax.experimental").enable_x64()


def _is_short(leaf: Any) -> bool:
    return (
        isinstance(leaf, jax.Array | np.ndarray)
        and jnp.issubdtype(leaf.dtype, jnp.floating)
        and leaf.dtype != np.float64
    )


def _lengthened(leaf: Any) -> Any:
    return jnp.asarray(np.asarray(leaf, dtype=np.float64)) if _is_short(leaf) else leaf


def in_double(function: Callable[P, R]) -> Callable[P, R]:
    """`function`, with every floating-point array in its arguments, problems included, in double precision."""

    @functools.wraps(function)
    def call(*arguments: P.args, **keywords: P.kwargs) -> R:
        if jax.config.jax_enable_x64 and not any(map(_is_short, jax.tree.leaves((arguments, keywords)))):  # type: ignore[attr-defined]
            return function(*arguments, **keywords)
        with double_precision():
            arguments, keywords = jax.tree.map(_lengthened, (arguments, keywords))
            return function(*arguments, **keywords)

    return call
