"""Policies of bounded Frobenius norm."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import as_array, check_shape, fail, is_concrete
from perfcontrol.sets.base import AbstractSet


class FrobeniusBall(AbstractSet):
    """{M : ‖M‖_F ≤ radius}.

    Args:
        radius: a nonnegative number.
    """

    limit: Array

    def __init__(self, radius: Any):
        self.limit = as_array("radius", radius)
        check_shape("radius", self.limit, (), (), "Pass one number.")
        if is_concrete(self.limit) and float(self.limit) < 0:
            raise fail("radius", f"{float(self.limit)}", "be nonnegative: the set is empty", "Pass a radius ≥ 0.")

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
