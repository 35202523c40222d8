"""From what a user passes to a policy map, and from a policy map to an array."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import as_array
from perfcontrol._functions import call
from perfcontrol.policy_maps.base import AbstractPolicyMap
from perfcontrol.policy_maps.constant import ConstantMap
from perfcontrol.policy_maps.function import Function


def as_policy_map(name: str, value: Any) -> AbstractPolicyMap:
    """A policy map as it is, a plain callable as `Function`, anything else as a constant array."""
    if isinstance(value, AbstractPolicyMap):
        return value
    return Function(value) if callable(value) else ConstantMap(as_array(name, value))


def evaluate_map(policy_map: AbstractPolicyMap, M: Array, name: str = "map") -> Array:
    """The value at M as an array in the precision of M; `name` is the argument that the map was passed as."""
    return call(name, lambda M: jnp.asarray(policy_map(M)).astype(M.dtype), M=M)
