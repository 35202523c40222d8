"""Scales whose sublevel sets the user has declared to be convex: cells bound the sizes of the scales themselves."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._programs import program
from perfcontrol.perturbations import DirectionalPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.descent import descend
from perfcontrol.theory.facts import nearest_to_zero
from perfcontrol.theory.optimality.relaxation import Least, Relaxation
from perfcontrol.theory.optimality.scalars import AbstractScalars

CUTS = 12  # planes that cut off policies outside a convex sublevel set
HALVINGS = 14  # of the way to a supporting plane, which holds wherever the halving stops
DESCENT = 300  # steps towards the least size of every scale
ABOUT = 1e-3  # distance at which a size is compared with those around it


class Sizes(AbstractScalars):
    """s = |σ|, one scale a direction, the same at all times."""

    def __init__(self, problem: PerformativeProblem, count: int):
        self.problem = problem
        points, sizes, around = _smallest(problem, np.asarray(nearest_to_zero(problem)), _directions(problem))
        self.inner = np.asarray(points, dtype=float).reshape(count, -1)  # policies at which each size is least
        # Where sublevel sets are convex, a size that is less nowhere about a policy is less nowhere at all.
        least = np.where(np.min(around, axis=1) > sizes * (1 - ABOUT**2), (1 - ABOUT**2) * sizes, 0.0)
        self.low, self.high = np.asarray(least, dtype=float), np.full(count, np.inf)

    def at(self, M: np.ndarray) -> np.ndarray:
        return np.asarray(_sizes(self.problem, M.reshape(self.problem.policy_shape)), dtype=float)

    def variances(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return np.broadcast_to(low**2, (self.problem.horizon, len(low)))

    def spread(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return high - low

    def least(self, relaxation: Relaxation, low: np.ndarray, high: np.ndarray, enough: float) -> Least:
        """By planes that support {|σ_k| ≤ high_k} on the way from where it is least to where the relaxation is."""
        normals, offsets = np.zeros((0, len(relaxation.base))), np.zeros(0)
        best = found = relaxation.least()
        for _ in range(CUTS):
            broken = np.flatnonzero(self.at(found.M) > high * (1 + 1e-9))
            cuts = [cut for k in broken if (cut := self._support(int(k), found.M, float(high[k]))) is not None]
            if best.value >= enough or not cuts:
                break
            normals = np.concatenate([normals, [normal for normal, _ in cuts]])
            offsets = np.concatenate([offsets, [normal @ (at - relaxation.base) for normal, at in cuts]])
            found = relaxation.on_halfspaces(normals, offsets, enough)
            best = found if found.value > best.value else best
        return best

    def _support(self, k: int, outside: np.ndarray, high: float) -> tuple[np.ndarray, np.ndarray] | None:
        """A plane {M : <normal, M - at> ≤ 0} that holds where |σ_k| ≤ high, since |σ_k(at)| > high, and cuts `outside`
        off."""
        near, far = self.inner[k], outside
        for _ in range(HALVINGS):
            middle = (near + far) / 2
            near, far = (near, middle) if self.at(middle)[k] > high else (middle, far)
        slopes = _slopes(self.problem, far.reshape(self.problem.policy_shape))
        normal = np.asarray(slopes[k], dtype=float).reshape(-1)
        size = np.linalg.norm(normal)
        return (normal / size, far) if np.isfinite(size) and size > 0 else None


@program
def _sizes(problem: PerformativeProblem, M: Any) -> Array:
    assert isinstance(problem.perturbation, DirectionalPerturbation)
    return jnp.abs(problem.perturbation.scale(problem.structure.lift(M)))


@program
def _slopes(problem: PerformativeProblem, M: Any) -> Array:
    return jax.jacrev(lambda M: _sizes(problem, M))(M)


def _directions(problem: PerformativeProblem) -> np.ndarray:
    """Both ways along every parameter, and some between, (D, *policy_shape)."""
    size = int(np.prod(problem.policy_shape))
    between = np.random.default_rng(0).normal(size=(4 * size, size))
    ways = np.concatenate([np.eye(size), between / np.linalg.norm(between, axis=1, keepdims=True)])
    return np.concatenate([ways, -ways]).reshape(-1, *problem.policy_shape)


@program
def _smallest(problem: PerformativeProblem, start: Any, directions: Any) -> tuple[Array, Array, Array]:
    """For each scale the policy at which descent finds its size least, that size (k,), and those about it (k, D)."""
    project, own = problem.feasible_set.project, jnp.arange(len(_sizes(problem, start)))

    def size(M: Array, k: Array) -> Array:
        return _sizes(problem, M)[k]

    def objective(policies: Array) -> tuple[Array, Array]:
        return jax.vmap(jax.value_and_grad(size))(policies, own)

    def per_scale(policies: Array) -> Array:
        return jax.vmap(size)(policies, own)

    first = jnp.broadcast_to(start, (len(own), *start.shape))
    nudged = jax.vmap(project)(first + ABOUT * directions[0])  # a kink may have no derivative
    values, slopes = objective(nudged)
    squares = jnp.sum(slopes**2, axis=(1, 2, 3))
    step = jnp.where(squares > 0, values / jnp.where(squares > 0, squares, 1), 1)
    ends = descend(objective, project, nudged, step, 1.0, 1e-12, DESCENT)[0]
    at_start = per_scale(first) <= per_scale(ends)
    points = jnp.where(at_start[:, None, None, None], first, ends)
    reach = ABOUT * (1 + jnp.sqrt(jnp.sum(points**2, axis=(1, 2, 3))))
    about = jax.vmap(project)((points + reach[:, None, None, None] * directions[:, None]).reshape(-1, *start.shape))
    around = jax.vmap(per_scale)(about.reshape(-1, *points.shape)).T
    return points, per_scale(points), around
