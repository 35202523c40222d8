"""What the families share about policy maps: shapes, suprema and slopes over a feasible set."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol.policy_maps import AbstractPolicyMap, Affine, evaluate_map

Dependence = AbstractPolicyMap | Array


def check_values(
    name: str, policy_map: Dependence, policy_shape: tuple[int, int, int], allowed: list[tuple[int, ...]], dtype: Any
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


def largest_entries(policy_map: Dependence, feasible_set: Any) -> Array | None:
    """sup over the set of |entries|; None where not known (a general function, an unbounded set)."""
    if not isinstance(policy_map, AbstractPolicyMap):
        return jnp.abs(policy_map)
    if not isinstance(policy_map, Affine):
        return None
    flat = policy_map.slope.reshape(-1, *policy_map.slope.shape[-3:])
    upper = feasible_set.support(flat)
    lower = feasible_set.support(-flat)
    if upper is None or lower is None:
        return None
    shape = policy_map.offset.shape
    return jnp.maximum(
        jnp.abs(policy_map.offset + upper.reshape(shape)), jnp.abs(policy_map.offset - lower.reshape(shape))
    )


def slopes(policy_map: Dependence) -> Array | None:
    """The derivative of an affine map, a zero scalar for a constant, None for a general function."""
    if not isinstance(policy_map, AbstractPolicyMap):
        return jnp.zeros(())
    return policy_map.slope if isinstance(policy_map, Affine) else None


def matrix_slope_norm(policy_map: Dependence) -> Array | None:
    """sup ‖dΘ_t‖_F over ‖dM‖_F = 1 of a matrix-valued map: scalar or (T,); None for a general function."""
    slope = slopes(policy_map)
    if slope is None or slope.ndim == 0:
        return slope
    return jnp.linalg.norm(
        slope.reshape(*slope.shape[:-5], slope.shape[-5] * slope.shape[-4], -1), ord=2, axis=(-2, -1)
    )
