"""How a quantity depends on the policy: the interface and one file a map."""

from typing import Any

from jaxtyping import Array

from perfcontrol._checks import as_array
from perfcontrol.policy_maps.affine import Affine
from perfcontrol.policy_maps.base import AbstractPolicyMap, evaluate_map
from perfcontrol.policy_maps.function import Function

__all__ = ["AbstractPolicyMap", "Affine", "Function", "as_policy_map", "evaluate_map"]


def as_policy_map(name: str, value: Any) -> AbstractPolicyMap | Array:
    """A policy map as it is, a plain callable as `Function`, anything else as a constant array."""
    if isinstance(value, AbstractPolicyMap):
        return value
    if callable(value):
        return Function(value)
    return as_array(name, value)
