"""The check that a policy map gives a family values of the right shape."""

from typing import Any

import jax

from perfcontrol._checks import fail
from perfcontrol.policy_maps import AbstractPolicyMap, evaluate_map


def check_values(
    name: str,
    policy_map: AbstractPolicyMap,
    policy_shape: tuple[int, int, int],
    allowed: list[tuple[int, ...]],
    dtype: Any,
) -> None:
    """Raise unless the map accepts a lifted policy and its values have one of the allowed shapes."""
    policy = jax.ShapeDtypeStruct(policy_shape, dtype)
    try:
        shape = jax.eval_shape(evaluate_map, policy_map, policy).shape
    except (TypeError, ValueError) as error:
        raise fail(
            name,
            f"an error from the policy map ({error})",
            f"accept a policy of shape {policy_shape}",
            "Policy maps receive the lifted policy (memory, input, state).",
        ) from error
    if shape not in allowed:
        raise fail(
            name,
            f"values of shape {shape}",
            "have values of shape " + " or ".join(map(str, allowed)),
            "The time axis comes first.",
        )
