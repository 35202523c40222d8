"""Numbers of the landscape: what policies about the stable and the optimal one cost, in their own and other worlds."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol._programs import program
from perfcontrol.evaluate.exact import exact_cost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory import PriceOfStability
from perfcontrol.theory.precision import in_double

LINE, PLANE = 61, 41  # points along each axis
REACH = 0.5  # how far beyond the policies, in units of their distance
FARTHEST = 4.0  # so far from the stable policy the naive one is still shown
ON_THE_LINE = 0.02  # distance from the line up to which the naive policy counts as being on it


class Landscape(NamedTuple):
    """Costs on the line M(s) = M^PS + s (M^PO - M^PS) and, where the naive policy is off it, on the plane of the three.

    Lengths are in units of ‖M^PO - M^PS‖_F; NaN where a policy is not feasible, infinity where it has no finite cost.
    s: (N,). costs: (N, N), C(M(s_j); M(s_i)). naive: (along, across) the line.
    plane_s, plane_t: (J,), (K,). own: (K, J), C(M; M) on the plane. frozen: (K, J), C(M; M^PS). None without a plane.
    """

    s: np.ndarray
    costs: np.ndarray
    naive: tuple[float, float]
    plane_s: np.ndarray | None = None
    plane_t: np.ndarray | None = None
    own: np.ndarray | None = None
    frozen: np.ndarray | None = None

    @property
    def has_plane(self) -> bool:
        """Whether the three policies span one."""
        return self.own is not None


@program
def _in_worlds(problem: PerformativeProblem, evaluated: Any, deployed: Any) -> tuple[Array, Array]:
    """C(M; M') for all of `evaluated` (E, ...) in each world of `deployed` (D, ...), (D, E); who is feasible, (E,)."""

    def row(world: Array) -> Array:
        return jax.vmap(lambda M: exact_cost(problem, M, world))(evaluated)

    feasible = jax.vmap(lambda M: problem.feasible_set.contains(M, 1e-8))(evaluated)
    return jax.lax.map(row, deployed), feasible


@program
def _in_their_own(problem: PerformativeProblem, policies: Any) -> Array:
    """C(M; M) of each policy."""
    return jax.lax.map(lambda M: exact_cost(problem, M, M), policies, batch_size=8)


@in_double
def landscape(problem: PerformativeProblem, price: PriceOfStability) -> Landscape:
    """The costs that the figure shows.

    Raises:
        InputError: stable and optimal policy are the same.
    """
    stable, along = price.stable, price.optimal - price.stable
    length = np.linalg.norm(along)
    if length <= 1e-8 * max(1.0, np.linalg.norm(stable)):
        raise fail(
            "problem",
            "one where both are the same",
            "have a stable policy that is not the optimal one",
            "Print pc.price_of_stability(problem): there is nothing to draw between them.",
        )
    offset = price.naive - stable
    shift = float(np.sum(offset * along) / length**2)
    across = offset - shift * along
    height = float(np.linalg.norm(across) / length)
    left, right = max(min(0.0, shift) - REACH, -FARTHEST), min(max(1.0, shift) + REACH, FARTHEST)
    s = np.unique(np.concatenate([np.linspace(left, right, LINE), [0.0, 1.0]]))
    line = stable + s[:, None, None, None] * along
    costs, feasible = _in_worlds(problem, line, line)
    costs = np.where(feasible & feasible[:, None], _none_infinite(costs), np.nan)
    if height <= ON_THE_LINE:
        return Landscape(s, costs, (shift, 0.0))
    plane_s = np.linspace(left, right, PLANE)
    low, high = min(0.0, height), max(0.0, min(height, FARTHEST))
    room = max(REACH, (right - left - (high - low)) / 2)  # as high as wide, where that is enough
    plane_t = np.linspace(low - room, high + room, PLANE)
    grid = stable + (plane_s[:, None, None, None] * along) + (plane_t[:, None, None, None, None] * across / height)
    policies = grid.reshape(-1, *stable.shape)
    frozen, feasible = _in_worlds(problem, policies, stable[None])
    own = _in_their_own(problem, policies)
    own, frozen = (np.where(feasible, _none_infinite(values.reshape(-1)), np.nan) for values in (own, frozen))
    shape = len(plane_t), len(plane_s)
    return Landscape(s, costs, (shift, height), plane_s, plane_t, own.reshape(shape), frozen.reshape(shape))


def _none_infinite(costs: Any) -> np.ndarray:
    """Costs that are no numbers are infinite: second moments without end."""
    return np.where(np.isfinite(costs), costs, np.inf)
