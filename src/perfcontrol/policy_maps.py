"""How a quantity depends on the policy: an affine map with known Lipschitz constant, or any function.

Most maps give an array; one that says how the noise reacts gives the law of a random vector.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import as_array, fail


class AbstractPolicyMap(eqx.Module):
    """M -> an array (or a law, for noise), where M is the lifted policy (memory, input, state)."""

    @abc.abstractmethod
    def __call__(self, M: Array) -> Any:
        """The value at the policy M."""


class Affine(AbstractPolicyMap):
    """offset + <slope, M>.

    Args:
        offset: the value at M = 0, any shape.
        slope: shape offset.shape + (memory, input, state): the derivative by M.
    """

    offset: Array
    slope: Array

    def __init__(self, offset: Any, slope: Any):
        self.offset = as_array("offset", offset)
        self.slope = as_array("slope", slope)
        if self.slope.ndim < 3 or self.slope.shape[:-3] != self.offset.shape:
            raise fail(
                "slope",
                f"{self.slope.shape}",
                f"have shape offset.shape + (memory, input, state) = {self.offset.shape} + (H, m, n)",
                "The three policy axes come last.",
            )

    def __call__(self, M: Array) -> Array:
        return self.offset + jnp.tensordot(self.slope, M, axes=3)


class Function(AbstractPolicyMap):
    """f(M, params), or f(M) when params is None.

    `params` are pytree leaves, so sweeping them recompiles nothing; `f` itself is static.
    """

    f: Callable = eqx.field(static=True)
    params: Any = None

    def __init__(self, f: Callable, params: Any = None):
        if not callable(f):
            raise fail("f", type(f).__name__, "be callable", "Pass a function of the policy M.")
        self.f = f
        self.params = None if params is None else jax.tree.map(lambda leaf: as_array("params", leaf), params)

    def __call__(self, M: Array) -> Any:
        return self.f(M) if self.params is None else self.f(M, self.params)


def as_policy_map(name: str, value: Any) -> AbstractPolicyMap | Array:
    """A policy map as it is, a plain callable as `Function`, anything else as a constant array."""
    if isinstance(value, AbstractPolicyMap):
        return value
    if callable(value):
        return Function(value)
    return as_array(name, value)


def evaluate_map(policy_map: AbstractPolicyMap | Array, M: Array) -> Array:
    """The value of a policy map, or of a constant, at M; in the precision of M."""
    value = policy_map(M) if isinstance(policy_map, AbstractPolicyMap) else policy_map
    return jnp.asarray(value).astype(M.dtype)
