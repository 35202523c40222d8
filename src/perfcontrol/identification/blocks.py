"""A block of estimated parameters with what every unit contributed: standard errors and resampling come from here."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg


@dataclass(frozen=True, eq=False)
class Block:
    """values (p,); score (U, p), adding up to zero, and information (U, p, p) of every unit at the estimate."""

    values: np.ndarray
    score: np.ndarray
    information: np.ndarray

    @cached_property
    def influence(self) -> np.ndarray:
        """What leaving out each unit would change in the values, (U, p), about its mean and with its sign turned.

        To first order the estimate without unit u differs by -(I - I_u)⁻¹ s_u: the jackknife. The usual sandwich
        I⁻¹ (Σ_u s_u s_uᵀ) I⁻¹ has I in the place of I - I_u and falls short where few units carry much information.
        """
        whole = self.information.sum(axis=0)
        scale = 1 / np.sqrt(np.maximum(np.diagonal(whole), 1e-300))
        values, vectors = np.linalg.eigh(whole * scale * scale[:, None])
        kept = values > 1e-9 * values.max(initial=0.0)
        root = scale[:, None] * vectors[:, kept] / np.sqrt(values[kept])  # root rootᵀ = I⁻¹
        rest = (1 + 1e-9) * np.eye(root.shape[1]) - root.T @ self.information @ root
        found = np.linalg.solve(rest, (self.score @ root)[:, :, None])[..., 0] @ root.T
        return found - found.mean(axis=0)

    def resampled(self, weights: np.ndarray) -> np.ndarray:
        """The values after one scoring step with weights (k, U) on the units, (k, p)."""
        size = len(self.values)
        information = (weights @ self.information.reshape(len(self.score), -1)).reshape(-1, size, size)
        return self.values + np.einsum("kpq,kq->kp", pseudo_inverse(information), weights @ self.score)


def pseudo_inverse(matrix: np.ndarray) -> np.ndarray:
    """Of positive semidefinite matrices (..., p, p), in columns of unit size."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
    both = scale[..., :, None] * scale[..., None, :]
    return both * np.linalg.pinv(matrix * both, rcond=1e-9, hermitian=True)


def hidden_directions(information: np.ndarray) -> np.ndarray:
    """A sparse basis (p, r) of what a positive semidefinite information (p, p) says nothing of."""
    diagonal = np.diag(information)
    silent = diagonal <= 1e-30 * diagonal.max(initial=1e-300)
    scale = 1 / np.sqrt(np.where(silent, 1.0, diagonal))
    values, vectors = np.linalg.eigh((information * scale * scale[:, None])[~silent][:, ~silent])
    basis = np.zeros((len(scale), len(scale)))
    basis[~silent, : len(values)] = vectors
    basis[silent, len(values) :] = np.eye(int(silent.sum()))
    null = basis[:, np.append(values < 1e-9 * values.max(initial=0.0), np.ones(int(silent.sum()), bool))]
    pivots = linalg.qr(null.T, mode="r", pivoting=True)[-1][: null.shape[1]]
    return scale[:, None] * null @ np.linalg.inv(null[pivots])
