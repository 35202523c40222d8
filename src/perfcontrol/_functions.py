"""Functions that a user passes: kept as pytrees, and called so that what they raise says which one it was."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.dtypes
import jax.errors
import jax.numpy as jnp

from perfcontrol._checks import InputError, fail


class _StaticCallable(eqx.Module):
    """A plain function as a pytree without leaves."""

    function: Callable = eqx.field(static=True)

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


def as_callable(name: str, value: Any) -> Any:
    """A callable as a pytree: modules and `jax.tree_util.Partial` with their leaves, plain functions without any."""
    if not callable(value):
        raise fail(name, type(value).__name__, "be callable", "Pass a function; swept numbers go in an eqx.Module.")
    if isinstance(value, eqx.Module | jax.tree_util.Partial):
        return value
    return _StaticCallable(value)


def call(name: str, function: Callable, /, **arguments: Any) -> Any:
    """function(*arguments) of a user's own function: what it raises says which one it was, and what it was given."""
    try:
        return function(*arguments.values())
    except Exception as error:
        given = ", ".join(_shaped(argument, value) for argument, value in arguments.items())
        if isinstance(error, InputError) and not isinstance(error, TypeError):  # it names an argument already
            error.add_note(f"Raised inside `{name}`, which was given {given}.")
            raise
        traced = isinstance(error, jax.errors.ConcretizationTypeError | jax.errors.TracerArrayConversionError)
        receiver = "A sampler" if "key" in arguments else "A policy map"
        lifted = f"{receiver} receives the lifted policy (memory, input, state). " if "M" in arguments else ""
        remedy = "Write it in jax.numpy, with jnp.where instead of if: numbers are not known while it is compiled."
        raise fail(
            name,
            " ".join(f"{type(error).__name__} from it: {error}".split("\n")[0].split()).rstrip(".: "),
            f"accept {given}",
            lifted + (remedy if traced else "Correct it: its own error stands above this one."),
        ) from error


def _shaped(name: str, value: Any) -> str:
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", ())
    if dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return f"a {name}"
    return f"{name} of shape {tuple(shape)}" if shape else name
