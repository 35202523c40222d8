"""No structure."""

import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol.sets.structures.base import AbstractStructure


class FullStructure(AbstractStructure):
    """Every entry of the policy is free."""

    def lift(self, parameters: Array) -> Array:
        return parameters

    def adjoint(self, M: Array) -> Array:
        return M

    def free_shape(self, policy_shape: tuple[int, int, int]) -> tuple[int, int, int]:
        return policy_shape

    def product_matrix(self, left: Array, right: Array, shape: tuple[int, int, int]) -> Array:
        return jnp.kron(left, right.T)

    @property
    def norm(self) -> float:
        return 1.0
