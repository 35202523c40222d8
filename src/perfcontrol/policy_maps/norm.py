"""Maps of how far a policy is from a given one."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import as_array, check_shape, fail, is_concrete
from perfcontrol.policy_maps.base import AbstractPolicyMap


class Norm(AbstractPolicyMap):
    """offset + weight ‖M - center‖_F, or with the square of the norm.

    Not differentiable at the center unless squared; derivatives taken there are zero.

    Args:
        offset: the value at the center, any shape that broadcasts against `weight`.
        weight: change per unit of distance (or of squared distance), likewise.
        center: a lifted policy (memory, input, state); None is zero.
        squared: whether the norm is squared.

    Raises:
        InputError: shapes that do not broadcast, or a center of another shape than the policy (when it is evaluated).
    """

    offset: Array
    weight: Array
    center: Array | None
    squared: bool = eqx.field(static=True)

    def __init__(self, offset: Any, weight: Any, center: Any = None, squared: bool = False):
        offset, weight = as_array("offset", offset), as_array("weight", weight)
        try:
            self.offset, self.weight = jnp.broadcast_arrays(offset, weight)
        except ValueError as error:
            required = f"broadcast against `offset` of shape {offset.shape}"
            raise fail("weight", f"{weight.shape}", required, "Pass one weight per entry, or one for all.") from error
        self.center = None if center is None else as_array("center", center)
        if self.center is not None and self.center.ndim != 3:
            required = "have shape (memory, input, state)"
            raise fail("center", f"{self.center.shape}", required, "Pass a lifted policy, or None for zero.")
        self.squared = bool(squared)

    def __call__(self, M: Array) -> Array:
        difference = M
        if self.center is not None:
            check_shape("center", self.center, M.shape, ("memory", "input", "state"), "It is a lifted policy.")
            difference = M - self.center
        squares = jnp.sum(difference**2)
        if self.squared:
            return self.offset + self.weight * squares
        apart = squares > 0  # the inner where keeps the derivative finite at the center
        return self.offset + self.weight * jnp.where(apart, jnp.sqrt(jnp.where(apart, squares, 1)), 0)

    def _center(self, feasible_set: Any) -> Array:
        return jnp.zeros(feasible_set.shape, self.offset.dtype) if self.center is None else self.center

    def range(self, feasible_set: Any) -> tuple[Array, Array] | None:
        """Exact where the set knows its nearest and farthest points; None on unbounded sets."""
        center = self._center(feasible_set)
        near, far = feasible_set.distance(center), feasible_set.farthest(center)
        if far is None:
            return None
        power = 2 if self.squared else 1
        ends = self.weight * near**power, self.weight * far**power
        return self.offset + jnp.minimum(*ends), self.offset + jnp.maximum(*ends)

    def lipschitz(self, feasible_set: Any) -> Array | None:
        """|weight|; squared, 2 |weight| sup ‖M - center‖, since |r² - s²| = (r + s) |r - s|."""
        if not self.squared:
            return jnp.abs(self.weight)
        far = feasible_set.farthest(self._center(feasible_set))
        return None if far is None else 2 * far * jnp.abs(self.weight)

    @property
    def continuous(self) -> bool:
        return True

    @property
    def convex(self) -> bool | None:
        """Whether offset weight ≥ 0; else |offset + weight r| falls at first, and {|entry| ≤ s} is a shell."""
        if not (is_concrete(self.offset) and is_concrete(self.weight)):
            return None
        return bool(np.all(np.asarray(self.offset) * np.asarray(self.weight) >= 0))
