"""The set of policies that lie in several sets."""

import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import check_instance, fail, is_concrete
from perfcontrol.sets.base import AbstractSet
from perfcontrol.sets.intersection.dykstra import Sets
from perfcontrol.sets.intersection.projection import ACCURACY, project, solve
from perfcontrol.sets.rows import RowSimplex


class Intersection(AbstractSet):
    """The policies that lie in every one of several sets.

    Projections come from Dykstra's algorithm with Newton steps, accurate to 1e-8 (usually to rounding) or NaN, which
    solvers report; their derivative from the fixed-point equations. Above 512 free parameters Dykstra works alone.

    Args:
        sets: one or more feasible sets, nested intersections included.

    Raises:
        InputError: no sets, or sets without a common point: at once where the sets tell the policy's shape, else when
            the problem is built.

    References:
        Boyle and Dykstra (1986), A method for finding projections onto the intersection of convex sets.
    """

    sets: Sets

    def __init__(self, sets: Any):
        if isinstance(sets, AbstractSet) or not isinstance(sets, Iterable):
            raise fail("sets", type(sets).__name__, "be a sequence of feasible sets", "Pass a list of sets.")
        sets = [check_instance(f"sets[{i}]", member, AbstractSet, "pc.Box(0.0, 1.0)") for i, member in enumerate(sets)]
        flat = [part for member in sets for part in (member.sets if isinstance(member, Intersection) else (member,))]
        if not flat:
            raise fail("sets", "none", "hold at least one set", "Pass pc.Unconstrained() for no constraint.")
        # Sets that fix signs come last: what projects last holds exactly.
        self.sets = tuple(sorted(flat, key=lambda member: member.nonnegative))
        for member in self.sets:
            shapes = [leaf.shape for leaf in jax.tree.leaves(member) if leaf.ndim == 3]
            if shapes:
                self.check(shapes[0])
                break

    def check(self, shape: tuple[int, ...]) -> None:
        for member in self.sets:
            member.check(shape)
        leaves = [leaf for leaf in jax.tree.leaves(self.sets) if eqx.is_array(leaf)]
        if not all(is_concrete(leaf) for leaf in leaves):
            return
        dtype = jnp.result_type(float, *[leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)])
        point = solve(self.sets, jnp.zeros(shape, dtype)).polished(self.sets, shape)
        gaps = [float(jnp.linalg.norm(point - member.project(point))) for member in self.sets]
        # Sets that touch are approached slowly: call them apart only where they clearly are.
        if not max(gaps) <= math.sqrt(ACCURACY) * (1 + float(jnp.linalg.norm(point))):
            worst = type(self.sets[int(np.argmax(gaps))]).__name__
            raise fail(
                "sets",
                f"no point, the nearest to zero of the last one being {max(gaps):.3g} away from the {worst}",
                "have a common point: their intersection is empty",
                "Relax one of them.",
            )

    def project(self, M: Array) -> Array:
        if len(self.sets) == 1:
            return self.sets[0].project(M)
        return project(self.sets, M)

    def contains(self, M: Array, tolerance: float = 1e-8) -> Array:
        """Whether every set contains M."""
        return jnp.all(jnp.stack([member.contains(M, tolerance) for member in self.sets]))

    def support(self, direction: Array) -> Array | None:
        """Proved upper bound, exact to about 1e-8 relative to the radius; None where no radius is known."""
        shape = direction.shape[-3:]
        reach = self.radius(shape)
        if reach is None:
            return None
        if len(self.sets) == 1:
            return self.sets[0].support(direction)
        flat = direction.reshape(-1, *shape)
        best = jax.lax.map(lambda d: _support(self.sets, d, reach.astype(d.dtype)), flat).reshape(direction.shape[:-3])
        return _least([best, *(member.support(direction) for member in self.sets)])

    @property
    def affine(self) -> bool:
        return all(member.affine for member in self.sets)

    def radius(self, shape: tuple[int, ...]) -> Array | None:
        """An upper bound: the least of the sets' radii."""
        return _least([member.radius(shape) for member in self._around])

    def farthest(self, center: Array) -> Array | None:
        """An upper bound: the least of the sets'."""
        return _least([member.farthest(center) for member in self._around])

    def distance(self, center: Array) -> Array:
        """A lower bound: the largest of the sets'."""
        return jnp.max(jnp.stack([member.distance(center) for member in self._around]))

    @property
    def _around(self) -> Sets:
        """Sets that the intersection is known to lie in."""
        fixed = self.nonnegative and self.row_total is not None
        return (*self.sets, RowSimplex(self.row_total)) if fixed else self.sets

    @property
    def row_total(self) -> Array | None:
        totals = [member.row_total for member in self.sets if member.row_total is not None]
        return totals[0] if totals else None

    @property
    def nonnegative(self) -> bool:
        return any(member.nonnegative for member in self.sets)


@eqx.filter_jit
def _support(sets: Sets, direction: Array, reach: Array) -> Array:
    """sup <direction, M> by two proximal steps from 0: x' = P(x + t d) leaves a gap of at most ‖x' - x‖ 2R/t."""
    norm = jnp.sqrt(jnp.sum(direction**2))
    unit = direction / jnp.where(norm > 0, norm, 1)
    length = (1e5 if direction.dtype == jnp.float64 else 1e2) * reach
    before = project(sets, length * unit)
    after = project(sets, before + length * unit)
    gap = jnp.sqrt(jnp.sum((after - before) ** 2)) * 2 * reach / jnp.where(length > 0, length, 1)
    rounding = 50 * float(jnp.finfo(direction.dtype).eps) * (length + reach)  # what projections of that length leave
    return norm * (jnp.sum(unit * after) + gap + rounding)


def _least(bounds: list[Array | None]) -> Array | None:
    """The least of those that are known, entry by entry."""
    known = [bound for bound in bounds if bound is not None]
    return jnp.min(jnp.stack(known), axis=0) if known else None
