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
                "The three policy axes come last.",
            )

    def __call__(self, M: Array) -> Array:
        return self.offset + jnp.tensordot(self.slope, M, axes=3)
