"""A user's own function of the policy."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array

from perfcontrol._checks import as_array, fail
from perfcontrol.policy_maps.base import AbstractPolicyMap


class Function(AbstractPolicyMap):
    """f(M, params), or f(M) when params is None.

    `params` are pytree leaves, so sweeping them recompiles nothing; `f` itself is static.

    Args:
        f: of the lifted policy (memory, input, state), and of `params` unless that is None.
        params: a pytree of numbers and arrays, or None.
        convex: whether {M : |entry| ≤ s} is convex for every entry of the value and every s; None for unknown.
    """

    f: Callable = eqx.field(static=True)
    params: Any = None
    declared_convex: bool | None = eqx.field(static=True, default=None)

    def __init__(self, f: Callable, params: Any = None, convex: bool | None = None):
        if not callable(f):
            raise fail("f", type(f).__name__, "be callable", "Pass a function of the policy M.")
        self.f = f
        self.params = None if params is None else jax.tree.map(lambda leaf: as_array("params", leaf), params)
        self.declared_convex = convex

    def __call__(self, M: Array) -> Any:
        return self.f(M) if self.params is None else self.f(M, self.params)

    @property
    def convex(self) -> bool | None:
        return self.declared_convex
