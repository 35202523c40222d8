"""What does not depend on the policy."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol.policy_maps.base import AbstractPolicyMap


class ConstantMap(AbstractPolicyMap):
    """The same array for every policy."""

    value: Array

    def __call__(self, M: Array) -> Array:
        return self.value

    def range(self, feasible_set: Any) -> tuple[Array, Array]:
        return self.value, self.value

    def lipschitz(self, feasible_set: Any) -> Array:
        return jnp.zeros_like(self.value)

    def matrix_bound(self, feasible_set: Any) -> Array:
        """The spectral norm itself."""
        return jnp.linalg.norm(self.value, ord=2, axis=(-2, -1))

    @property
    def constant(self) -> bool:
        return True

    @property
    def continuous(self) -> bool:
        return True

    @property
    def convex(self) -> bool:
        return True
