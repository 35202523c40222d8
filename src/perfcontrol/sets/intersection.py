"""Intersections of feasible sets: Dykstra's projections, finished by Newton steps on their fixed-point equations.

With y the point to project, x its projection and p_i the part of y - x that set i is responsible for,

    x = P_i(x + p_i) for every set i,     y = x + Σ_i p_i,

and conversely any such x is the projection. Dykstra's sweep keeps the second equation exactly and drives the first
ones to hold; that is safe from everywhere but only linear at best, and can stall. A Newton step through the
derivatives of the P_i is tried after some sweeps, and taken where it makes the defect smaller. The same linear
system, solved once at the end, is the derivative of the projection.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from perfcontrol._checks import fail, is_concrete
from perfcontrol._linalg import symmetrise, transpose
from perfcontrol.sets.base import AbstractSet
from perfcontrol.sets.rows import RowSimplex

SWEEPS = 20  # of Dykstra between two Newton steps
ROUNDS = 12  # of sweeps and a Newton step in a stage, at first; doubled when a stage fails
MOST_ROUNDS = 400
STAGES = 60  # on the way to a point far outside, at most
LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03)  # of Newton steps
NEWTON_LIMIT = 512  # free parameters up to which derivatives of projections are held as matrices
ACCURACY = 1e-8  # what a projection promises, relative

Sets = tuple[AbstractSet, ...]


class _Split(eqx.Module):
    """A point x and the parts p_i, with x + Σ p_i = y; the defect is √Σ‖P_i(x + p_i) - x‖²."""

    x: Float[Array, " p"]
    parts: Float[Array, "k p"]
    defect: Float[Array, ""]


def _projections(sets: Sets, points: Float[Array, "k p"], shape: tuple[int, ...]) -> Float[Array, "k p"]:
    """P_i of the i-th row."""
    return jnp.stack([s.project(z.reshape(shape)).reshape(-1) for s, z in zip(sets, points, strict=True)])


def _split(sets: Sets, x: Array, parts: Array, shape: tuple[int, ...]) -> _Split:
    return _Split(x, parts, jnp.sqrt(jnp.sum((_projections(sets, x + parts, shape) - x) ** 2)))


def _sweep(sets: Sets, x: Array, parts: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """One round of Dykstra: every set in turn takes over what it moved."""
    rows = []
    for member, part in zip(sets, parts, strict=True):
        point = x + part
        x = member.project(point.reshape(shape)).reshape(-1)
        rows.append(point - x)
    return x, jnp.stack(rows)


class _Linearised:
    """The equations dx = J_i (dx + dp_i) + e_i, dx + Σ dp_i = dy, J_i the derivative of P_i at x + p_i.

    Along the null space of J_i they fix dx; across them dp_i = J_i⁺ (dx - e_i) - Π_i dx with Π_i = J_i⁺ J_i.
    """

    def __init__(self, sets: Sets, split: _Split, shape: tuple[int, ...]):
        negligible = float(jnp.finfo(split.x.dtype).eps) ** 0.75
        eye = jnp.eye(split.x.size, dtype=split.x.dtype)
        slopes = []
        for member, part in zip(sets, split.parts, strict=True):

            def flat(z: Array, member: AbstractSet = member) -> Array:
                return member.project(z.reshape(shape)).reshape(-1)

            slopes.append(jax.jacfwd(flat)(split.x + part))
        values, vectors = jnp.linalg.eigh(symmetrise(jnp.stack(slopes)))
        kept = (values > negligible)[:, None, :]
        self.inverses = (vectors * jnp.where(kept, 1 / jnp.where(kept, values[:, None, :], 1), 0)) @ transpose(vectors)
        self.normals = (vectors * ~kept) @ transpose(vectors)
        values, vectors = jnp.linalg.eigh(jnp.sum(self.normals, axis=0))
        fixed = values > 10 * negligible
        self.held = (vectors * jnp.where(fixed, 1 / jnp.where(fixed, values, 1), 0)) @ vectors.T
        self.free = (vectors * ~fixed) @ vectors.T
        self.metric = eye + jnp.sum(self.inverses + self.normals - eye, axis=0)
        self.system = jax.scipy.linalg.cho_factor(self.free @ self.metric @ self.free + eye - self.free)

    def move(self, errors: Float[Array, "k p"], dy: Float[Array, " p"]) -> Array:
        """dx."""
        held = self.held @ jnp.einsum("kab,kb->a", self.normals, errors)
        right = dy + jnp.einsum("kab,kb->a", self.inverses, errors) - self.metric @ held
        return held + self.free @ jax.scipy.linalg.cho_solve(self.system, self.free @ right)

    def parts(self, errors: Float[Array, "k p"], dx: Array, dy: Array) -> Float[Array, "k p"]:
        """dp_i, the undetermined components shared out evenly."""
        moved = jnp.einsum("kab,kb->ka", self.inverses, dx - errors) - (dx - self.normals @ dx)
        rest = self.held @ (dy - dx - jnp.sum(moved, axis=0))
        return moved + self.normals @ rest


class _Progress(eqx.Module):
    """How far along the segment from a nearly feasible point to y the projection is known, and what is tried next."""

    reached: Float[Array, ""]  # fraction of the segment; 0 before the first success
    parts: Float[Array, "k p"]  # there
    tried: Float[Array, ""]
    growth: Float[Array, ""]  # of the fraction from stage to stage
    split: _Split  # of the last trial
    rounds: Int[Array, ""]
    count: Int[Array, ""]


@eqx.filter_jit
def _solve(sets: Sets, M: Array, newton: bool = True) -> _Split:
    """The projection of M as a `_Split`; `newton=False` leaves Dykstra alone.

    A point far outside, in units of the sets, is approached in stages along the segment from a nearly feasible point:
    the parts grow in proportion, so that each stage starts close to its solution.
    """
    shape, dtype = M.shape, M.dtype
    y = M.reshape(-1)
    goal = 50 * float(jnp.finfo(dtype).eps) * (1 + jnp.sqrt(jnp.sum(y**2)))
    enough = goal * (100 if dtype == jnp.float64 else 2)
    newton = newton and y.size <= NEWTON_LIMIT
    effort = 1 if newton else 50
    zero, lengths = jnp.zeros_like(y), jnp.asarray(LENGTHS, dtype)

    def improve(carry: tuple[_Split, Array, Array]) -> tuple[_Split, Array, Array]:
        split, best, count = carry
        x, parts = jax.lax.fori_loop(
            0, SWEEPS, lambda _, now: _sweep(sets, now[0], now[1], shape), (split.x, split.parts)
        )
        split = _split(sets, x, parts, shape)
        if newton:
            linear = _Linearised(sets, split, shape)
            errors = _projections(sets, x + parts, shape) - x
            dx = linear.move(errors, zero)
            dparts = linear.parts(errors, dx, zero)
            tried = jax.vmap(lambda t: _split(sets, x + t * dx, parts + t * dparts, shape))(lengths)
            chosen = jax.tree.map(lambda leaf: leaf[jnp.nanargmin(tried.defect)], tried)
            # Only for real progress on all before, so that Dykstra, which must converge, is left alone in the end.
            better = chosen.defect < best / 2
            split = jax.tree.map(lambda new, old: jnp.where(better, new, old), chosen, split)
            best = jnp.where(better, chosen.defect, best)
        return split, best, count + 1

    start = _split(sets, y, jnp.zeros((len(sets), y.size), dtype), shape)
    centre = jax.lax.fori_loop(0, SWEEPS, lambda _, x: _sweep(sets, x, jnp.zeros_like(start.parts), shape)[0], y)

    def stage(now: _Progress) -> _Progress:
        target = centre + now.tried * (y - centre)
        parts = now.parts * (now.tried / jnp.where(now.reached > 0, now.reached, 1))
        first = _split(sets, target - jnp.sum(parts, axis=0), parts, shape)

        def unsolved(carry: tuple[_Split, Array, Array]) -> Array:
            return (carry[0].defect > goal) & (carry[2] < now.rounds)

        split, _, _ = jax.lax.while_loop(unsolved, improve, (first, first.defect, jnp.asarray(0)))
        solved = split.defect <= enough
        reached = jnp.where(solved, now.tried, now.reached)
        growth = jnp.where(solved | (now.reached == 0), now.growth, jnp.sqrt(now.growth))
        following = jnp.where(reached > 0, jnp.minimum(growth * reached, 1), now.tried / 64)
        rounds = jnp.where(solved, now.rounds, jnp.minimum(2 * now.rounds, effort * MOST_ROUNDS))
        parts = jnp.where(solved, split.parts, now.parts)
        return _Progress(reached, parts, following, growth, split, rounds, now.count + 1)

    def unfinished(now: _Progress) -> Array:
        return (now.reached < 1) & (now.count < STAGES)

    reached = jnp.where(start.defect > goal, 0.0, 1.0).astype(dtype)
    one = jnp.ones((), dtype)
    first = _Progress(reached, start.parts, one, 8 * one, start, jnp.asarray(effort * ROUNDS), jnp.asarray(0))
    last = jax.lax.while_loop(unfinished, stage, first)
    # Where even that fails, the split of the start keeps the defect honest: it is not small.
    return jax.tree.map(lambda new, old: jnp.where(last.reached < 1, old, new), last.split, start)


def _point(sets: Sets, M: Array, split: _Split) -> Array:
    """The projection that a split of M tells, or NaN where it was not found.

    It is polished by the last set, so that bounds hold exactly where that set is a box.
    """
    nearest = sets[-1].project((split.x + split.parts[-1]).reshape(M.shape))
    accuracy = ACCURACY if M.dtype == jnp.float64 else 1e4 * ACCURACY
    found = split.defect <= accuracy * (1 + jnp.sqrt(jnp.sum(M**2)))
    return jnp.where(found, nearest, jnp.nan)


@eqx.filter_custom_jvp
def _project(sets: Sets, M: Array) -> Array:
    return _point(sets, M, _solve(sets, M))


@_project.def_jvp
def _project_derivative(primals: tuple[Sets, Array], tangents: tuple[Any, Array | None]) -> tuple[Array, Array]:
    sets, M = jax.tree.map(jnp.asarray, primals)
    moved_sets, dM = tangents
    shape = M.shape
    split = _solve(sets, M)
    value = _point(sets, M, split)
    dy = jnp.zeros_like(split.x) if dM is None else dM.reshape(-1)
    rows = []
    for member, tangent, part in zip(sets, moved_sets, split.parts, strict=True):
        point = (split.x + part).reshape(shape)
        if jax.tree.leaves(tangent):
            rows.append(eqx.filter_jvp(lambda s, z=point: s.project(z), (member,), (tangent,))[1].reshape(-1))
        else:
            rows.append(jnp.zeros_like(split.x))
    linear = _Linearised(sets, split, shape)
    return value, linear.move(jnp.stack(rows), dy).reshape(shape)


@eqx.filter_jit
def _support(sets: Sets, direction: Array, reach: Array) -> Array:
    """sup <direction, M> by two proximal steps from 0: x' = P(x + t d) leaves a gap of at most ‖x' - x‖ 2R/t."""
    norm = jnp.sqrt(jnp.sum(direction**2))
    unit = direction / jnp.where(norm > 0, norm, 1)
    length = (1e5 if direction.dtype == jnp.float64 else 1e2) * reach
    before = _project(sets, length * unit)
    after = _project(sets, before + length * unit)
    gap = jnp.sqrt(jnp.sum((after - before) ** 2)) * 2 * reach / jnp.where(length > 0, length, 1)
    rounding = 50 * float(jnp.finfo(direction.dtype).eps) * (length + reach)  # what projections of that length leave
    return norm * (jnp.sum(unit * after) + gap + rounding)


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
        if isinstance(sets, AbstractSet) or not all(isinstance(member, AbstractSet) for member in sets):
            raise fail("sets", repr(type(sets).__name__), "be a sequence of feasible sets", "Pass a list of sets.")
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
        split = _solve(self.sets, jnp.zeros(shape, dtype))
        point = self.sets[-1].project((split.x + split.parts[-1]).reshape(shape))
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
        return _project(self.sets, M)

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


def _least(bounds: list[Array | None]) -> Array | None:
    """The least of those that are known, entry by entry."""
    known = [bound for bound in bounds if bound is not None]
    return jnp.min(jnp.stack(known), axis=0) if known else None
