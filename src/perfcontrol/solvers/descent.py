"""Descent from several points at once: spectral projected gradient steps on any objective, all points in one batch.

    d = Proj(x - α g) - x,    x ← x + λ d,    α ← ‖s‖² / <s, y>  (Barzilai and Borwein),

λ shortened until the objective falls below the largest of its last values (Grippo, Lampariello and Lucidi). No point
ever ends above where it started.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

Objective = Callable[[Array], tuple[Array, Array]]  # policies (S, ...) -> values (S,), gradients (S, ...)

REMEMBERED = 5  # values among which the largest is to be undercut
SUFFICIENT = 1e-4  # least decrease, relative to what the slope promises
RANGE = 1e4  # of α about where it starts
SHORTEST = 1e-9  # λ below which a point has stopped


def descend(
    objective: Objective,
    project: Callable[[Array], Array],
    points: Array,
    first_step: Any,
    scale: Any,
    tolerance: Any,
    limit: Any,
) -> tuple[Array, Array, Array]:
    """Points, values and gradients after at most `limit` steps, or once no point moves more than `tolerance · scale`.

    Args:
        objective: evaluates all points. project: the projection of one point.
        points: (S, ...), feasible.
        first_step: α of the first step, a number or (S,).
        scale: what moves are measured by.
    """
    axes = tuple(range(1, points.ndim))

    def wide(numbers: Array) -> Array:
        return numbers.reshape(-1, *[1] * len(axes))

    def inner(a: Array, b: Array) -> Array:
        return jnp.sum(a * b, axis=axes)

    def advance(carry: Any) -> Any:
        x, f, g, recent, alpha, length, moving, count = carry
        d = jax.vmap(project)(x - wide(alpha) * g) - x
        trial = jax.vmap(project)(x + wide(length) * d)  # again: far outside, projections are rounded coarsely
        value, gradient = objective(trial)
        slope = inner(g, d)
        good = moving & (value <= jnp.max(recent, axis=1) + SUFFICIENT * length * slope)
        good = good & jnp.all(jnp.isfinite(gradient), axis=axes)
        s, y = trial - x, gradient - g
        curved, squared = inner(s, y), inner(s, s)
        spectral = jnp.where(curved > 0, squared / jnp.where(curved > 0, curved, 1), jnp.inf)
        spectral = jnp.clip(spectral, first_step / RANGE, first_step * RANGE)
        # Where the value rose, the parabola through both values and the slope says where it is lowest.
        risen = value - f - length * slope
        lowest = -slope * length**2 / (2 * jnp.where(risen > 0, risen, 1))
        shorter = jnp.where(risen > 0, jnp.clip(lowest, 0.1 * length, 0.5 * length), length / 4)
        stopped = good & (jnp.sqrt(squared) <= tolerance * scale) & (length == 1)
        kept = jnp.roll(recent, 1, axis=1).at[:, 0].set(value)
        return (
            jnp.where(wide(good), trial, x),
            jnp.where(good, value, f),
            jnp.where(wide(good), gradient, g),
            jnp.where(good[:, None], kept, recent),
            jnp.where(good, spectral, alpha),
            jnp.where(good, 1, shorter),
            moving & ~stopped & (good | (shorter > SHORTEST)),
            count + 1,
        )

    def unfinished(carry: Any) -> Array:
        *_, moving, count = carry
        return jnp.any(moving) & (count < limit)

    f, g = objective(points)
    sound = jnp.isfinite(f) & jnp.all(jnp.isfinite(g), axis=axes)
    f, g = jnp.where(sound, f, jnp.inf), jnp.where(wide(sound), g, 0)
    alpha = jnp.broadcast_to(jnp.asarray(first_step, f.dtype), f.shape)
    recent = jnp.broadcast_to(f[:, None], (len(f), REMEMBERED))
    first = (points, f, g, recent, alpha, jnp.ones_like(f), sound, jnp.asarray(0))
    x, f, g, *_ = jax.lax.while_loop(unfinished, advance, first)
    return x, f, g
