"""A gradient from observed costs alone: two evaluations along a random direction, in the same world."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, fail, is_concrete
from perfcontrol._linalg import frobenius
from perfcontrol.evaluate.paths import over_paths
from perfcontrol.evaluate.rollout import run_path, sample_path
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.gradients import AbstractGradient


class TwoPoint(AbstractGradient):
    """p/(2r) (J(M + rU; deployed) - J(M - rU; deployed)) U, U uniform on the unit sphere of the p free parameters.

    Both costs are of the same draws of x_0, noise and perturbation, whose law reacts to `deployed`, not to M ± rU; each
    of the `batch` pairs of paths has a direction of its own. The mean is the gradient of C(·; deployed) averaged over
    the ball of radius r: the gradient itself for quadratic costs at any r, else with a bias of order r². Its variance
    is about p times that of `pc.Pathwise`. The two policies may lie outside the feasible set by r.

    Args:
        radius: r > 0, in units of the free parameters.

    Raises:
        InputError: a radius that is not a positive number.

    References:
        Not in the paper. Flaxman, Kalai and McMahan (2005) for the smoothing, Shamir (2017) for two points.
    """

    radius: Array

    def __init__(self, radius: Any):
        self.radius = as_array("radius", radius)
        if is_concrete(self.radius) and not (self.radius.ndim == 0 and float(self.radius) > 0):
            remedy = "Pass for example 0.1: for quadratic costs its size only matters for rounding."
            raise fail("radius", str(self.radius), "be a positive number", remedy)

    def __call__(
        self, problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""], batch: int
    ) -> Array:
        reacting, radius = problem.structure.lift(deployed), self.radius.astype(M.dtype)

        def one(key: Array) -> Array:
            path_key, direction_key = jax.random.split(key)
            direction = jax.random.normal(direction_key, M.shape, M.dtype)
            direction = direction / frobenius(direction)
            forward = sample_path(problem, problem.structure.lift(M + radius * direction), reacting, path_key)
            policy = problem.structure.lift(M - radius * direction)
            backward = run_path(problem, policy, forward.x[0], forward.w, forward.draws)
            # Stage by stage, so that the large common part cancels before it is summed.
            stages = (problem.cost.path_cost(path.x, path.u) for path in (forward, backward))
            difference = jnp.sum(next(stages) - next(stages))
            return M.size / (2 * radius) * difference * direction

        return jnp.mean(over_paths(problem, one, key, batch), axis=0)
