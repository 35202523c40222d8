"""How far the best response stretches distances, sampled over the feasible set."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import check_integer
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import respond


@eqx.filter_jit
def _responses(problem: PerformativeProblem, policies: Array) -> Array:
    return jax.lax.map(lambda M: respond(problem, M).M, policies)


def contraction_estimate(
    problem: PerformativeProblem, *, pairs: int = 16, key: Any = None, center: Array | None = None
) -> float:
    """Largest ‖Φ(M) - Φ(M')‖ / ‖M - M'‖ over sampled pairs of feasible policies: a lower estimate of the modulus.

    Args:
        pairs: how many. key: JAX random key; a fixed one if None. center: the policy that they are drawn around.
    """
    pairs = check_integer("pairs", pairs, 1)
    key = jax.random.key(11) if key is None else key
    center = problem.initial_policy() if center is None else center
    radius = problem.feasible_set.radius(problem.policy_shape)
    scale = float(1 + jnp.linalg.norm(center)) if radius is None else float(radius)
    draws = jax.random.normal(key, (2 * pairs, *problem.policy_shape), problem.dtype)
    unit = draws / jnp.linalg.norm(draws.reshape(2 * pairs, -1), axis=1)[:, None, None, None]
    reach = scale * jnp.logspace(-2, 0.5, pairs)[:, None, None, None]
    first = center + reach * unit[:pairs]
    # every other pair is close together, so that steep places count as much as distant ones
    apart = jnp.where(jnp.arange(pairs)[:, None, None, None] % 2 == 0, reach, 0.02 * scale)
    policies = jax.vmap(problem.feasible_set.project)(jnp.concatenate([first, first + apart * unit[pairs:]]))
    images = _responses(problem, policies)
    moved = jnp.linalg.norm((images[:pairs] - images[pairs:]).reshape(pairs, -1), axis=1)
    distance = jnp.linalg.norm((policies[:pairs] - policies[pairs:]).reshape(pairs, -1), axis=1)
    return float(jnp.max(jnp.where(distance > 1e-12, moved / jnp.where(distance > 0, distance, 1), 0)))
