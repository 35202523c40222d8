"""Scales that go by the distance from one policy: cells are shells about it."""

import jax.numpy as jnp
import numpy as np

from perfcontrol.policy_maps import Norm
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.optimality.relaxation import Least, Relaxation, on_shell
from perfcontrol.theory.optimality.scalars import AbstractScalars


class Distance(AbstractScalars):
    """σ = offset + weight r, or r², r² = norm² s² + outside², s = ‖M - center‖ of the free parameters."""

    def __init__(self, problem: PerformativeProblem, scale: Norm, shape: tuple[int, int]):
        lifted = problem.lifted_shape
        center = np.zeros(lifted) if scale.center is None else np.asarray(scale.center, dtype=float)
        free = np.asarray(problem.structure.adjoint(jnp.asarray(center))) / problem.structure.norm**2
        self.outside = float(np.linalg.norm(center - np.asarray(problem.structure.lift(jnp.asarray(free)))))
        self.center, self.norm = free.reshape(-1).astype(float), problem.structure.norm
        self.offset, self.weight = (np.broadcast_to(np.asarray(x, float), shape) for x in (scale.offset, scale.weight))
        self.power = 2 if scale.squared else 1
        far = problem.feasible_set.farthest(jnp.asarray(free))
        self.low = np.atleast_1d(np.asarray(problem.feasible_set.distance(jnp.asarray(free)), dtype=float))
        self.high = np.atleast_1d(np.inf if far is None else np.asarray(far, dtype=float))

    def at(self, M: np.ndarray) -> np.ndarray:
        return np.atleast_1d(np.linalg.norm(M - self.center))

    def _scale(self, s: float) -> np.ndarray:
        reach = np.hypot(self.norm * s, self.outside) ** self.power
        with np.errstate(invalid="ignore"):
            return self.offset + np.where(self.weight == 0, 0.0, self.weight * reach)

    def variances(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        near, far = self._scale(float(low[0])), self._scale(float(high[0]))
        return np.where(np.sign(near) * np.sign(far) <= 0, 0.0, np.minimum(near**2, far**2))

    def spread(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return high - low

    def least(self, relaxation: Relaxation, low: np.ndarray, high: np.ndarray, enough: float) -> Least:
        return on_shell(relaxation, self.center, float(low[0]), float(high[0]))
