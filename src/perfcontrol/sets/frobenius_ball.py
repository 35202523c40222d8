"""Policies of bounded Frobenius norm."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import as_radius
from perfcontrol.sets.base import AbstractSet


class FrobeniusBall(AbstractSet):
    """{M : ‖M‖_F ≤ radius}.

    Args:
        radius: a nonnegative number.
    """

    limit: Array

    def __init__(self, radius: Any):
        self.limit = as_radius(radius)

    def project(self, M: Array) -> Array:
        # The inner where keeps the derivative finite at M = 0.
        squared = jnp.sum(M**2)
        outside = squared > self.limit**2
        norm = jnp.sqrt(jnp.where(outside, squared, 1))
        return jnp.where(outside, self.limit / norm, 1) * M

    def support(self, direction: Array) -> Array:
        return self.limit * jnp.sqrt(jnp.sum(direction**2, axis=(-3, -2, -1)))

    def radius(self, shape: tuple[int, ...]) -> Array:
        return self.limit
