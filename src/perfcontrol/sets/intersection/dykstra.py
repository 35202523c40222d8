"""A point split among several sets, and Dykstra's sweep over them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol.sets.base import AbstractSet

Sets = tuple[AbstractSet, ...]


class Split(eqx.Module):
    """A point x and the parts p_i, with x + Σ p_i = y; the defect is √Σ‖P_i(x + p_i) - x‖²."""

    x: Float[Array, " p"]
    parts: Float[Array, "k p"]
    defect: Float[Array, ""]

    def polished(self, sets: Sets, shape: tuple[int, ...]) -> Array:
        """x as the last set gives it, so that bounds hold exactly where that set is a box."""
        return sets[-1].project((self.x + self.parts[-1]).reshape(shape))


def projections(sets: Sets, points: Float[Array, "k p"], shape: tuple[int, ...]) -> Float[Array, "k p"]:
    """P_i of the i-th row."""
    return jnp.stack([s.project(z.reshape(shape)).reshape(-1) for s, z in zip(sets, points, strict=True)])


def split_at(sets: Sets, x: Array, parts: Array, shape: tuple[int, ...]) -> Split:
    """x and parts with their defect."""
    return Split(x, parts, jnp.sqrt(jnp.sum((projections(sets, x + parts, shape) - x) ** 2)))


def sweep(sets: Sets, x: Array, parts: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """One round of Dykstra: every set in turn takes over what it moved."""
    rows = []
    for member, part in zip(sets, parts, strict=True):
        point = x + part
        x = member.project(point.reshape(shape)).reshape(-1)
        rows.append(point - x)
    return x, jnp.stack(rows)
