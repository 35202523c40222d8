"""The nearest common point of several sets: in stages, by sweeps and Newton steps; and its derivative."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from perfcontrol.sets.intersection.dykstra import Sets, Split, split_at, sweep
from perfcontrol.sets.intersection.newton import Linearised, newton_step

SWEEPS = 20  # of Dykstra between two Newton steps
ROUNDS = 12  # of sweeps and a Newton step in a stage, at first; doubled when a stage fails
MOST_ROUNDS = 400
STAGES = 60  # on the way to a point far outside, at most
NEWTON_LIMIT = 512  # free parameters up to which derivatives of projections are held as matrices
ACCURACY = 1e-8  # what a projection promises, relative


class Progress(eqx.Module):
    """How far along the segment from a nearly feasible point to y the projection is known, and what is tried next."""

    reached: Float[Array, ""]  # fraction of the segment; 0 before the first success
    parts: Float[Array, "k p"]  # there
    tried: Float[Array, ""]
    growth: Float[Array, ""]  # of the fraction from stage to stage
    split: Split  # of the last trial
    rounds: Int[Array, ""]
    count: Int[Array, ""]


@eqx.filter_jit
def solve(sets: Sets, M: Array, newton: bool = True) -> Split:
    """The projection of M as a `Split`; `newton=False` leaves Dykstra alone.

    A point far outside, in units of the sets, is approached in stages along the segment from a nearly feasible point:
    the parts grow in proportion, so that each stage starts close to its solution.
    """
    shape, dtype = M.shape, M.dtype
    y = M.reshape(-1)
    goal = 50 * float(jnp.finfo(dtype).eps) * (1 + jnp.sqrt(jnp.sum(y**2)))
    enough = goal * (100 if dtype == jnp.float64 else 2)
    newton = newton and y.size <= NEWTON_LIMIT
    effort = 1 if newton else 50

    def improve(carry: tuple[Split, Array, Array]) -> tuple[Split, Array, Array]:
        split, best, count = carry
        x, parts = jax.lax.fori_loop(
            0, SWEEPS, lambda _, now: sweep(sets, now[0], now[1], shape), (split.x, split.parts)
        )
        split = split_at(sets, x, parts, shape)
        if newton:
            chosen = newton_step(sets, split, shape)
            # Only for real progress on all before, so that Dykstra, which must converge, is left alone in the end.
            better = chosen.defect < best / 2
            split = jax.tree.map(lambda new, old: jnp.where(better, new, old), chosen, split)
            best = jnp.where(better, chosen.defect, best)
        return split, best, count + 1

    start = split_at(sets, y, jnp.zeros((len(sets), y.size), dtype), shape)
    centre = jax.lax.fori_loop(0, SWEEPS, lambda _, x: sweep(sets, x, jnp.zeros_like(start.parts), shape)[0], y)

    def stage(now: Progress) -> Progress:
        target = centre + now.tried * (y - centre)
        parts = now.parts * (now.tried / jnp.where(now.reached > 0, now.reached, 1))
        first = split_at(sets, target - jnp.sum(parts, axis=0), parts, shape)

        def unsolved(carry: tuple[Split, Array, Array]) -> Array:
            return (carry[0].defect > goal) & (carry[2] < now.rounds)

        split, _, _ = jax.lax.while_loop(unsolved, improve, (first, first.defect, jnp.asarray(0)))
        solved = split.defect <= enough
        reached = jnp.where(solved, now.tried, now.reached)
        growth = jnp.where(solved | (now.reached == 0), now.growth, jnp.sqrt(now.growth))
        following = jnp.where(reached > 0, jnp.minimum(growth * reached, 1), now.tried / 64)
        rounds = jnp.where(solved, now.rounds, jnp.minimum(2 * now.rounds, effort * MOST_ROUNDS))
        parts = jnp.where(solved, split.parts, now.parts)
        return Progress(reached, parts, following, growth, split, rounds, now.count + 1)

    def unfinished(now: Progress) -> Array:
        return (now.reached < 1) & (now.count < STAGES)

    reached = jnp.where(start.defect > goal, 0.0, 1.0).astype(dtype)
    one = jnp.ones((), dtype)
    first = Progress(reached, start.parts, one, 8 * one, start, jnp.asarray(effort * ROUNDS), jnp.asarray(0))
    last = jax.lax.while_loop(unfinished, stage, first)
    # Where even that fails, the split of the start keeps the defect honest: it is not small.
    return jax.tree.map(lambda new, old: jnp.where(last.reached < 1, old, new), last.split, start)


def _point(sets: Sets, M: Array, split: Split) -> Array:
    """The projection that a split of M tells, or NaN where it was not found."""
    accuracy = ACCURACY if M.dtype == jnp.float64 else 1e4 * ACCURACY
    found = split.defect <= accuracy * (1 + jnp.sqrt(jnp.sum(M**2)))
    return jnp.where(found, split.polished(sets, M.shape), jnp.nan)


@eqx.filter_custom_jvp
def project(sets: Sets, M: Array) -> Array:
    """The nearest point of all sets to M, or NaN where it was not found."""
    return _point(sets, M, solve(sets, M))


@project.def_jvp
def _project_derivative(primals: tuple[Sets, Array], tangents: tuple[Any, Array | None]) -> tuple[Array, Array]:
    sets, M = jax.tree.map(jnp.asarray, primals)
    moved_sets, dM = tangents
    shape = M.shape
    split = solve(sets, M)
    value = _point(sets, M, split)
    dy = jnp.zeros_like(split.x) if dM is None else dM.reshape(-1)
    rows = []
    for member, tangent, part in zip(sets, moved_sets, split.parts, strict=True):
        point = (split.x + part).reshape(shape)
        if jax.tree.leaves(tangent):
            rows.append(eqx.filter_jvp(lambda s, z=point: s.project(z), (member,), (tangent,))[1].reshape(-1))
        else:
            rows.append(jnp.zeros_like(split.x))
    linear = Linearised(sets, split, shape)
    return value, linear.move(jnp.stack(rows), dy).reshape(shape)
