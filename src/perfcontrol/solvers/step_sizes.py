"""Step sizes η_n of iteration n = 0, 1, ..."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import as_array, check_parentheses, fail, is_concrete
from perfcontrol._functions import call


class InverseStep(eqx.Module):
    """η_n = phi1 / (n + phi2): the diminishing step of Theorem 1.

    Examples:
        >>> float(InverseStep(2.0, 8.0)(0))
        0.25

    Args:
        phi1: a positive number.
        phi2: likewise.
    """

    phi1: Array
    phi2: Array

    def __init__(self, phi1: Any, phi2: Any):
        self.phi1, self.phi2 = as_array("phi1", phi1), as_array("phi2", phi2)
        for name, value in (("phi1", self.phi1), ("phi2", self.phi2)):
            if is_concrete(value) and not (value.ndim == 0 and float(value) > 0):
                raise fail(name, str(value), "be a positive number", "Pass a positive number: Theorem 1 needs both.")

    def __call__(self, n: Array) -> Array:
        return self.phi1 / (n + self.phi2)


class PowerStep(eqx.Module):
    """η_n = eta (1 + n / delay)^{-alpha}: slower than 1/n, so that averages of iterates are asymptotically efficient.

    The first `delay` steps or so keep their length; after that they fall. A start far off is forgotten sooner with a
    delay of some 1 / (eta λ), λ the smallest eigenvalue of ∂g(M; M).

    Examples:
        >>> round(float(PowerStep(0.5, 0.75)(15)), 4)
        0.0625
        >>> round(float(PowerStep(0.5, 0.75, delay=100)(1500)), 4)
        0.0625

    Args:
        eta: the first step, a positive number.
        alpha: the exponent, 1/2 < alpha < 1.
        delay: a positive number.

    Raises:
        InputError: numbers outside these ranges.

    References:
        Not in the paper; docs: theory, "Averaged iterates".
    """

    eta: Array
    alpha: Array
    delay: Array

    def __init__(self, eta: Any, alpha: Any = 0.6, delay: Any = 1.0):
        self.eta, self.alpha, self.delay = as_array("eta", eta), as_array("alpha", alpha), as_array("delay", delay)
        for name, value, remedy in (
            ("eta", self.eta, "It is the first step."),
            ("delay", self.delay, "1 lets steps fall from the start."),
        ):
            if is_concrete(value) and not (value.ndim == 0 and float(value) > 0):
                raise fail(name, str(value), "be a positive number", remedy)
        if is_concrete(self.alpha) and not (self.alpha.ndim == 0 and 0.5 < float(self.alpha) < 1):
            raise fail(
                "alpha",
                str(self.alpha),
                "be a number between 1/2 and 1, both excluded",
                "Pass 0.6, or pc.InverseStep(phi1, phi2) for steps that fall like 1/n.",
            )

    def __call__(self, n: Array) -> Array:
        return self.eta * (1 + jnp.asarray(n, self.eta.dtype) / self.delay) ** -self.alpha


class ConstantStep(eqx.Module):
    """η_n = size."""

    size: Array

    def __init__(self, size: Any):
        self.size = as_array("step_size", size)
        if is_concrete(self.size) and not (self.size.ndim == 0 and float(self.size) > 0):
            raise fail(
                "step_size",
                str(self.size),
                "be a positive number",
                "Pass a positive number, or pc.InverseStep(phi1, phi2).",
            )

    def __call__(self, n: Array) -> Array:
        return self.size


class _FunctionStep(eqx.Module):
    function: Callable = eqx.field(static=True)

    def __call__(self, n: Array) -> Array:
        return jnp.asarray(self.function(n))


def size_of(rule: Any, n: Array) -> Array:
    """η_n as a scalar."""
    size = call("step_size", lambda n: jnp.asarray(rule(n)), n=n)
    if size.shape:
        raise fail("step_size", f"values of shape {size.shape}", "give one number for each n", "Return a scalar.")
    return size


def as_step_size(value: Any) -> Any:
    """A number, an `InverseStep`, a `PowerStep`, or a function n -> η_n."""
    if isinstance(value, InverseStep | PowerStep | ConstantStep | _FunctionStep):
        return value
    check_parentheses("step_size", value, "be a number, a function of n, or `pc.InverseStep(phi1, phi2)`")
    if callable(value):
        return value if isinstance(value, eqx.Module) else _FunctionStep(value)
    return ConstantStep(value)
