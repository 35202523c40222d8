"""Scales that are affine in the policy: they depend on as many linear functions of it as their slopes have rank."""

import numpy as np

from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.derivatives import tangent_basis
from perfcontrol.theory.facts import nearest_to_zero
from perfcontrol.theory.optimality.relaxation import Least, Relaxation, support
from perfcontrol.theory.optimality.scalars import AbstractScalars


class Linear(AbstractScalars):
    """σ = offset + slopes s, s = rows (M - base): offset (T, k), slopes (T, k, d), rows (d, p) orthonormal."""

    def __init__(self, problem: PerformativeProblem, offset: np.ndarray, slopes: np.ndarray):
        basis = tangent_basis(problem)
        self.base = np.asarray(nearest_to_zero(problem), dtype=float).reshape(-1)
        flat = slopes.reshape(-1, slopes.shape[-1])
        _, values, right = np.linalg.svd(flat @ basis, full_matrices=False)
        rank = int(np.sum(values > 1e-12 * (1 + np.abs(flat).max(initial=0.0))))
        self.rows = right[:rank] @ basis.T
        self.offset = offset + slopes @ self.base
        self.slopes = slopes @ self.rows.T
        self.low, self.high = (side * np.inf * np.ones(rank) for side in (-1, 1))
        directions = self.rows.reshape(rank, *problem.policy_shape)
        reach = support(problem.feasible_set, np.concatenate([directions, -directions])) if rank else None
        if reach is not None:
            above, below = np.asarray(reach, dtype=float).reshape(2, rank)
            self.low, self.high = -below - self.rows @ self.base, above - self.rows @ self.base

    def at(self, M: np.ndarray) -> np.ndarray:
        return self.rows @ (M - self.base)

    def variances(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        # A scale that does not move with a scalar is not unbounded because the scalar is.
        with np.errstate(invalid="ignore"):
            ends = (
                np.where(self.slopes == 0, 0.0, self.slopes * low),
                np.where(self.slopes == 0, 0.0, self.slopes * high),
            )
        least, most = (self.offset + pick(*ends).sum(axis=-1) for pick in (np.minimum, np.maximum))
        return np.where((least <= 0) & (most >= 0), 0.0, np.minimum(least**2, most**2))

    def spread(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return np.linalg.norm(self.slopes, axis=(0, 1)) * (high - low)

    def least(self, relaxation: Relaxation, low: np.ndarray, high: np.ndarray, enough: float) -> Least:
        return relaxation.on_box(self.rows, low, high, enough) if len(low) else relaxation.least()
