"""How far the best response stretches distances, sampled over the feasible set."""

from typing import Any

import jax
import numpy as np

from perfcontrol._checks import check_integer, check_key
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import respond
from perfcontrol.response.projected import nearest
from perfcontrol.theory.existence import set_radius
from perfcontrol.theory.facts import nearest_to_zero
from perfcontrol.theory.precision import in_double

DEFAULT_SEED = 11


@in_double
def contraction_estimate(
    problem: PerformativeProblem, *, pairs: int = 16, key: Any = None, center: Any = None
) -> float:
    """Largest ‖Φ(M) - Φ(M')‖ / ‖M - M'‖ over sampled pairs of feasible policies: a lower estimate of the modulus.

    Args:
        problem: the problem.
        pairs: how many.
        key: JAX random key; a fixed one if None.
        center: the policy that they are drawn around; None: the one nearest to zero.
    """
    pairs = check_integer("pairs", pairs, 1)
    seed = DEFAULT_SEED if key is None else np.asarray(jax.random.key_data(check_key(key)))
    center = nearest_to_zero(problem) if center is None else np.asarray(problem.check_policy("center", center))
    radius = set_radius(problem)
    scale = 1 + float(np.linalg.norm(center)) if radius is None else radius
    draws = np.random.default_rng(seed).standard_normal((2, pairs, *center.shape))
    unit = draws / np.linalg.norm(draws.reshape(2, pairs, -1), axis=-1)[..., None, None, None]

    def respond_to(M: np.ndarray) -> np.ndarray:
        return np.asarray(respond(problem, M).M, dtype=float)

    def feasible(M: np.ndarray) -> np.ndarray:
        return np.asarray(nearest(problem.feasible_set, M.astype(center.dtype)))

    largest = 0.0
    for pair, reach in enumerate(scale * np.logspace(-2, 0.5, pairs)):
        # every other pair is close together, so that steep places count as much as distant ones
        apart = reach if pair % 2 == 0 else 0.02 * scale
        first = center + reach * unit[0, pair]
        one, two = feasible(first), feasible(first + apart * unit[1, pair])
        distance = float(np.linalg.norm(one.astype(float) - two))
        if distance > 1e-12:
            largest = max(largest, float(np.linalg.norm(respond_to(one) - respond_to(two))) / distance)
    return largest
