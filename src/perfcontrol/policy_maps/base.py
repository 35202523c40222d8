"""How a quantity depends on the policy: an affine map with known Lipschitz constant, or any function.

Most maps give an array; one that says how the noise reacts gives the law of a random vector.
"""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array


class AbstractPolicyMap(eqx.Module):
    """M -> an array (or a law, for noise), where M is the lifted policy (memory, input, state)."""

    @abc.abstractmethod
    def __call__(self, M: Array) -> Any:
        """The value at the policy M."""


def evaluate_map(policy_map: AbstractPolicyMap | Array, M: Array) -> Array:
    """The value of a policy map, or of a constant, at M; in the precision of M."""
    value = policy_map(M) if isinstance(policy_map, AbstractPolicyMap) else policy_map
    return jnp.asarray(value).astype(M.dtype)
