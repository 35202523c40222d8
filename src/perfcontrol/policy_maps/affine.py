"""Affine maps of the policy."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import as_array, fail
from perfcontrol.policy_maps.base import AbstractPolicyMap


class Affine(AbstractPolicyMap):
    """offset + <slope, M>.

    Args:
        offset: the value at M = 0, any shape.
        slope: shape offset.shape + (memory, input, state): the derivative by M.
    """

    offset: Array
    slope: Array

    def __init__(self, offset: Any, slope: Any):
        self.offset = as_array("offset", offset)
        self.slope = as_array("slope", slope)
        if self.slope.ndim < 3 or self.slope.shape[:-3] != self.offset.shape:
            raise fail(
                "slope",
                f"{self.slope.shape}",
                f"have shape offset.shape + (memory, input, state) = {self.offset.shape} + (H, m, n)",
                "Put the three policy axes last.",
            )

    def __call__(self, M: Array) -> Array:
        return self.offset + jnp.tensordot(self.slope, M, axes=3)

    def range(self, feasible_set: Any) -> tuple[Array, Array] | None:
        """Exact where the support function of the set is; None where it may be infinite."""
        below, above = feasible_set.support(-self.slope), feasible_set.support(self.slope)
        return None if below is None or above is None else (self.offset - below, self.offset + above)

    def lipschitz(self, feasible_set: Any) -> Array:
        return jnp.sqrt(jnp.sum(self.slope**2, axis=(-3, -2, -1)))

    def matrix_lipschitz(self, feasible_set: Any, weights: Any = 1.0) -> Array:
        """The largest singular value of the derivative."""
        slope = jnp.asarray(weights)[..., None, None, None] * self.slope
        *time, rows, columns = self.offset.shape
        return jnp.linalg.norm(slope.reshape(*time, rows * columns, -1), ord=2, axis=(-2, -1))

    def derivative(self) -> Array:
        return self.slope

    @property
    def continuous(self) -> bool:
        return True

    @property
    def convex(self) -> bool:
        return True
