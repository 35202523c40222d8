"""Small helpers shared by the tests."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import perfcontrol as pc

DOUBLE = bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]


def tolerance(double: float, single: float) -> float:
    """The first in float64, the second in float32."""
    return double if DOUBLE else single


def relative_error(value: Any, reference: Any) -> float:
    """The largest deviation, relative to the largest entry of the reference (1 where that is zero)."""
    value, reference = np.asarray(value, dtype=float), np.asarray(reference, dtype=float)
    assert value.shape == reference.shape, f"shapes {value.shape} and {reference.shape}"
    scale = np.abs(reference).max(initial=0.0)
    return float(np.abs(value - reference).max(initial=0.0) / (scale if scale > 0 else 1.0))


def assert_close(value: Any, reference: Any, double: float = 1e-12, single: float = 1e-4) -> None:
    """Agreement relative to the largest entry of the reference."""
    assert relative_error(value, reference) <= tolerance(double, single)


def assert_mean_is(samples: Any, expected: Any, errors: float = 5.0) -> None:
    """The mean over the first axis lies within `errors` standard errors of `expected`, entry by entry."""
    samples, expected = np.asarray(samples, dtype=float), np.asarray(expected, dtype=float)
    standard_error = samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
    rounding = tolerance(1e-12, 3e-5) * max(1.0, float(np.abs(samples).max(initial=0.0)))
    gap = np.abs(samples.mean(axis=0) - expected)
    assert np.all(gap <= errors * standard_error + rounding), f"{np.max(gap / (standard_error + rounding)):.3g} errors"


def central_differences(function: Callable[[np.ndarray], Any], point: Any, step: float) -> np.ndarray:
    """The gradient of a scalar function by central differences; exact up to rounding for a quadratic."""
    point = np.asarray(point, dtype=float)
    gradient = np.zeros_like(point)
    for index in np.ndindex(*point.shape):
        forward, backward = point.copy(), point.copy()
        forward[index] += step
        backward[index] -= step
        gradient[index] = (float(function(forward)) - float(function(backward))) / (2 * step)
    return gradient


def normal(seed: int, *shape: int) -> jax.Array:
    """Fixed standard normal numbers in the precision of the run."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), dtype=float)


def random_psd(seed: int, size: int, *leading: int) -> jax.Array:
    """Fixed positive definite matrices."""
    root = np.random.default_rng(seed).normal(size=(*leading, size, size))
    return jnp.asarray(root @ root.swapaxes(-1, -2) / size + 0.1 * np.eye(size), dtype=float)


def assert_refused(build: Callable[[], Any], name: str, *words: str) -> None:
    """`build` raises the four-part error about `name`: what is required, what was got, what to do; `words` occur."""
    disabled = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)  # else annotations may refuse a wrong type first
    try:
        with pytest.raises(pc.InputError) as caught:
            build()
    finally:
        jaxtyping.config.update("jaxtyping_disable", disabled)
    text = str(caught.value)
    assert text.startswith(f"`{name}` must "), text
    required, _, rest = text.removeprefix(f"`{name}` must ").partition("; got ")
    got, _, remedy = rest.partition(". ")
    assert required and got and remedy.strip(), f"not of four parts: {text}"
    for word in words:
        assert word in text, f"{word!r} is missing in: {text}"
