"""A block of estimated parameters with what every unit contributed: standard errors and resampling come from here."""

from typing import NamedTuple

import numpy as np


class Block(NamedTuple):
    """values (p,); score (U, p), adding up to zero, and information (U, p, p) of every unit at the estimate."""

    values: np.ndarray
    score: np.ndarray
    information: np.ndarray

    def bread(self) -> np.ndarray:
        """Inverse of the information."""
        return np.linalg.pinv(self.information.sum(axis=0), rcond=1e-12, hermitian=True)

    def covariance(self) -> np.ndarray:
        """The sandwich I⁻¹ (Σ_u s_u s_uᵀ) I⁻¹, robust to unequal variances, times U / (U - 1)."""
        count = len(self.score)
        influence = self.score @ self.bread()
        return influence.T @ influence * count / max(count - 1, 1)

    def standard_errors(self) -> np.ndarray:
        """Of the values, (p,)."""
        return np.sqrt(np.diag(self.covariance()))

    def resampled(self, weights: np.ndarray) -> np.ndarray:
        """The values after one scoring step with weights (k, U) on the units, (k, p)."""
        size = len(self.values)
        information = (weights @ self.information.reshape(len(self.score), -1)).reshape(-1, size, size)
        inverse = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
        return self.values + np.einsum("kpq,kq->kp", inverse, weights @ self.score)
