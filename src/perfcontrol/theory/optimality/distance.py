"""Scales that go by the distance from one policy: cells are shells about it."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from perfcontrol.policy_maps import Norm
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.optimality.relaxation import Least, Relaxation, on_shell
from perfcontrol.theory.optimality.scalars import AbstractScalars


class Distance(AbstractScalars):
    """σ = offset + weight r, or r², r² = norm² s² + outside², s = ‖M - center‖ of the free parameters."""

    def __init__(
        self, center: np.ndarray, low: Any, high: Any, offset: Any, weight: Any, power: int, norm: float, outside: float
    ):
        self.center, self.offset, self.weight, self.power = center, np.asarray(offset), np.asarray(weight), power
        self.norm, self.outside = norm, outside
        self.low, self.high = (np.atleast_1d(np.asarray(end, dtype=float)) for end in (low, high))

    @classmethod
    def of(cls, problem: PerformativeProblem, scale: Norm, shape: tuple[int, int]) -> "Distance":
        """The distance that a `Norm` goes by, of the free parameters, values of `shape` (T, k)."""
        center = jnp.zeros(problem.lifted_shape) if scale.center is None else jnp.asarray(scale.center, float)
        structure = problem.structure
        free = structure.adjoint(center) / structure.norm**2
        outside = float(np.linalg.norm(center - structure.lift(free)))
        offset, weight = (np.broadcast_to(np.asarray(part, float), shape) for part in (scale.offset, scale.weight))
        near, far = problem.feasible_set.distance(free), problem.feasible_set.farthest(free)
        origin, power = np.asarray(free, dtype=float).reshape(-1), 2 if scale.squared else 1
        return cls(origin, near, np.inf if far is None else far, offset, weight, power, structure.norm, outside)

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
