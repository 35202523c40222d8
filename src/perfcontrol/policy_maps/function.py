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
