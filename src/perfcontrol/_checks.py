"""Input checks with one wording of errors: the argument, what was got, what is required, the remedy."""

import inspect
import math
import re
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.core
import jax.dtypes
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


class InputError(ValueError):
    """An argument is wrong; raised before any work starts."""


_warned_about_precision = False


def fail(name: str, got: str, required: str, remedy: str) -> InputError:
    """The error that every check raises: "`name` must ...; got ... Remedy." """
    first, *rest = got.splitlines() or [got]
    got = f"{first} ..." if rest else got  # an array printed on several lines
    return InputError(f"`{name}` must {required}; got {got}. {remedy}")


def is_concrete(value: Any) -> bool:
    """Whether values (not only shapes) can be looked at: False under jit, vmap and grad."""
    return not isinstance(value, jax.core.Tracer)


def check_parentheses(name: str, value: Any, required: str) -> None:
    """Raise for a class where an object is meant."""
    if isinstance(value, type):
        needed = any(p.default is p.empty for p in inspect.signature(value).parameters.values())
        call = f"pc.{value.__name__}({'...' if needed else ''})"
        raise fail(name, f"the class {value.__name__}", required, f"Add parentheses: {call}.")


def check_instance(name: str, value: Any, kind: type, example: str) -> Any:
    """`value` where it is an instance of `kind`; else say what that is, by an example, or that parentheses lack."""
    if isinstance(value, kind):
        return value
    words = re.sub("(?<=[a-z])(?=[A-Z])", " ", kind.__name__.removeprefix("Abstract")).lower()
    required = f"be a {words}, such as `{example}`"
    if isinstance(value, type) and issubclass(value, kind) and not inspect.isabstract(value):
        check_parentheses(name, value, required)
    got = f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
    remedy = f"Build one, or subclass `pc.{kind.__name__}`." if inspect.isabstract(kind) else "Build one."
    if kind.__name__ == "LinearSystem" and type(value).__module__.startswith(("control.", "scipy.signal")):
        remedy = f"Pass {name}=pc.interop.from_control(plant)."
    raise fail(name, "None" if value is None else got, required, remedy)


def as_array(name: str, value: Any, remedy: str = "") -> Array:
    """`value` as a finite floating-point array of JAX's current default precision.

    `remedy` is for numbers that are not finite.
    """
    global _warned_about_precision
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jnp.floating):
        array = value
    else:
        try:
            host = np.asarray(value)
            if host.dtype == object or not (
                np.issubdtype(host.dtype, np.number) or np.issubdtype(host.dtype, np.bool_)
            ):
                raise TypeError(f"dtype {host.dtype}")
            if np.iscomplexobj(host):
                raise TypeError("complex numbers")
        except (TypeError, ValueError) as error:
            if isinstance(value, jax.Array):  # an integer tracer: NumPy cannot read it, JAX can convert it
                return jnp.asarray(value, dtype=float)
            raise fail(
                name,
                "None" if value is None else f"{type(value).__name__} ({error})",
                "be an array of real numbers",
                "Pass solution.M."
                if type(value).__name__ == "Solution"
                else "Pass a number, a rectangular nested list, a NumPy array or a JAX array.",
            ) from error
        if host.dtype == np.float64 and not jax.config.jax_enable_x64 and not _warned_about_precision:  # type: ignore[attr-defined]
            _warned_about_precision = True
            if isinstance(value, np.ndarray):
                warnings.warn(
                    "float64 data arrived while JAX works in float32: it is rounded. For double precision call "
                    'jax.config.update("jax_enable_x64", True) before anything else (said once).',
                    stacklevel=3,
                )
        array = jnp.asarray(host, dtype=float)
    # NumPy, not JAX: inside a trace even an operation on known numbers gives a tracer.
    if is_concrete(array) and not np.all(np.isfinite(np.asarray(array))):
        host = np.asarray(array)
        if host.ndim == 0:
            raise fail(name, f"{host}", "be finite", remedy or "Pass a finite number.")
        bad = np.argwhere(~np.isfinite(host))[0].tolist()
        remedy = remedy or "Replace what is infinite or missing before it is passed on."
        raise fail(name, f"{host[tuple(bad)]} at index {bad}", "have finite entries only", remedy)
    return array


def check_finite(what: str, answer: Any) -> Any:
    """`answer` where all its numbers are finite (or traced); raise OverflowError otherwise."""
    for leaf in jax.tree.leaves(answer):
        if is_concrete(leaf) and not np.all(np.isfinite(np.asarray(leaf))):
            raise OverflowError(
                f"{what} overflows {leaf.dtype.name} at this policy: the second moments of the state grow too "
                "fast over the horizon. Use a policy of smaller norm, a shorter horizon, or a stabilising gain."
            )
    return answer


def check_shape(name: str, array: Any, expected: Sequence[int], labels: Sequence[str], remedy: str = "") -> None:
    """Raise unless `array.shape == expected`; `labels` names the axes."""
    expected = tuple(expected)
    if tuple(array.shape) == expected:
        return
    if not expected:
        raise fail(name, f"shape {tuple(array.shape)}", "be one number", remedy or "Pass a single number.")
    axes = ", ".join(labels) + ("," if len(labels) == 1 else "")
    hint = remedy or "Check the axis order: (sample, time, lag, input, state)."
    if len(expected) >= 2 and array.shape == (*expected[:-2], expected[-1], expected[-2]):
        hint = "The last two axes look swapped: pass its transpose."
    raise fail(name, f"{tuple(array.shape)}", f"have shape ({axes}) = {expected}", hint)


def varies(name: str, got: str) -> InputError:
    """The error of something that varies in time where there is no last time."""
    return fail(
        name,
        got,
        "be the same at all times where the horizon is infinite",
        "Drop its time axis, or pass a finite horizon.",
    )


def check_time_varying(
    name: str,
    array: Array,
    inner: Sequence[int],
    labels: Sequence[str],
    length: int | float,
    length_label: str = "time",
) -> None:
    """Raise unless `array` has shape `inner` (constant) or `(length, *inner)`."""
    inner = tuple(inner)
    if array.ndim == len(inner) + 1 and math.isinf(length):
        raise varies(name, f"shape {tuple(array.shape)}")
    if array.ndim == len(inner) + 1:
        check_shape(
            name,
            array,
            (int(length), *inner),
            (length_label, *labels),
            f"A constant of shape {inner} is accepted too." if array.shape[1:] == inner else "",
        )
    else:
        check_shape(name, array, inner, labels)


def check_nonnegative(name: str, array: Any, remedy: str, because: str = "") -> None:
    """Raise where an entry is known to be negative; `because` says what that would mean."""
    if is_concrete(array) and np.any(np.asarray(array) < 0):
        raise fail(name, f"{float(np.min(array))}", "be nonnegative" + because, remedy)


def check_symmetric_psd(name: str, array: Array, remedy: str) -> None:
    """Raise unless every matrix in the last two axes is symmetric positive semidefinite (to rounding)."""
    if not is_concrete(array):
        return
    host = np.asarray(array, dtype=float)
    scale, precision = np.max(np.abs(host), initial=0.0), np.finfo(np.asarray(array).dtype)
    if 0 < scale < float(precision.tiny):
        raise fail(
            name,
            f"entries of at most {scale:.3g}",
            f"be zero, or have an entry above {float(precision.tiny):.3g}: smaller ones count as zero when compiled",
            "Choose larger units.",
        )
    slack = 100 * float(precision.eps) * max(scale, np.finfo(float).tiny) * host.shape[-1]
    asymmetry = float(np.max(np.abs(host - np.swapaxes(host, -1, -2)), initial=0.0))
    if asymmetry > slack:
        raise fail(
            name,
            f"an asymmetry of {asymmetry:.3g}",
            "be symmetric",
            f"Pass ({name} + {name}.T) / 2.",
        )
    smallest = float(np.min(np.linalg.eigvalsh(host), initial=np.inf))
    if smallest < -slack:
        raise fail(name, f"smallest eigenvalue {smallest:.3g}", "be positive semidefinite", remedy)


def as_radius(value: Any) -> Array:
    """The radius of a ball: one nonnegative number."""
    unbounded = isinstance(value, float | np.floating) and value == np.inf
    remedy = "Pass pc.Unconstrained() for a set without bound." if unbounded else ""
    radius = as_array("radius", value, remedy)
    check_shape("radius", radius, (), (), "Pass one number.")
    if is_concrete(radius) and float(radius) < 0:
        raise fail("radius", f"{float(radius)}", "be nonnegative: the set is empty", "Pass a radius ≥ 0.")
    return radius


def check_integer(name: str, value: Any, minimum: int) -> int:
    """`value` as a Python int of at least `minimum`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise fail(name, repr(value), "be an integer", f"Pass a whole number of at least {minimum}.")
    if value < minimum:
        raise fail(name, str(value), f"be at least {minimum}", f"Pass a whole number of at least {minimum}.")
    return int(value)


def check_key(key: Any) -> Any:
    """A JAX random key, typed or raw; there is no default."""
    if key is None:
        raise fail("key", "None", "be a JAX random key", "Pass key=jax.random.key(0): randomness is explicit here.")
    if isinstance(key, int | np.integer):
        raise fail("key", repr(key), "be a JAX random key", f"Pass key=jax.random.key({key}).")
    raw = isinstance(key, jax.Array) and key.dtype == jnp.uint32 and key.ndim > 0
    if not raw and not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        got = f"an array of {key.dtype}" if isinstance(key, jax.Array) else type(key).__name__
        raise fail("key", got, "be a JAX random key", "Pass key=jax.random.key(0).")
    # raw keys of jax.random.PRNGKey draw the same numbers as their typed form
    key = jax.random.wrap_key_data(key) if raw else key
    if key.shape:
        raise fail("key", f"keys of shape {key.shape}", "be one JAX random key", "Pass one of them, or use jax.vmap.")
    return key


def check_positive_tolerance(tolerance: Any) -> float | None:
    """A relative tolerance, or None for the default of the precision that will be used."""
    if tolerance is not None and not (isinstance(tolerance, int | float | np.floating) and 0 < tolerance < np.inf):
        raise fail("tolerance", repr(tolerance), "be a positive number", "Pass None for the default.")
    return None if tolerance is None else float(tolerance)


def check_tolerance(tolerance: float | None, dtype: Any) -> float:
    """The relative tolerance, 1e-11 in float64 and 1e-5 in float32 when None; raise if `dtype` cannot reach it."""
    check_positive_tolerance(tolerance)
    epsilon = float(jnp.finfo(dtype).eps)
    double = epsilon < 1e-12
    if tolerance is None:
        return 1e-11 if double else 1e-5
    floor = 20 * epsilon
    if tolerance < floor:
        remedy = (
            "Pass tolerance=None for the default."
            if double
            else 'Pass a larger one, or call jax.config.update("jax_enable_x64", True) first.'
        )
        raise fail(
            "tolerance",
            f"{tolerance:.3g}",
            f"be at least {floor:.1e}, what {jnp.dtype(dtype).name} can reach",
            remedy,
        )
    return float(tolerance)


def as_names(argument: str, names: Any, count: int) -> tuple[str, ...] | None:
    """Names of so many signals, or None."""
    if names is None:
        return None
    names = (names,) if isinstance(names, str) else tuple(names)
    if len(names) != count or len(set(names)) < count or not all(isinstance(name, str) for name in names):
        raise fail(argument, f"{list(names)}", f"be {count} different names", "Pass one text for each signal.")
    return names
