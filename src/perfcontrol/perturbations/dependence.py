"""What the families ask of a policy map: scales without a pointless sign, and values of the right shape."""

from typing import Any

import jax

from perfcontrol._checks import check_nonnegative, fail
from perfcontrol.policy_maps import AbstractPolicyMap, ConstantMap, as_policy_map, evaluate_map


def as_scale(name: str, value: Any) -> AbstractPolicyMap:
    """The map that multiplies something whose sign does not matter: as a constant it has no reason to be negative."""
    policy_map = as_policy_map(name, value)
    if isinstance(policy_map, ConstantMap):
        check_nonnegative(name, policy_map.value, "Only its square matters: pass its absolute value.")
    return policy_map


def check_values(
    name: str,
    policy_map: AbstractPolicyMap,
    policy_shape: tuple[int, int, int],
    allowed: list[tuple[int, ...]],
    dtype: Any,
) -> None:
    """Raise unless the map accepts a lifted policy and its values have one of the allowed shapes."""
    policy = jax.ShapeDtypeStruct(policy_shape, dtype)
    shape = jax.eval_shape(lambda value, M: evaluate_map(value, M, name), policy_map, policy).shape
    if shape not in allowed:
        raise fail(
            name,
            f"values of shape {shape}",
            "have values of shape " + " or ".join(map(str, allowed)),
            "Return such an array: the time axis comes first.",
        )
