"""The first two conditional moments of a transition: scores and information of their coefficients, unit by unit.

Given x and v, a transition of deployment g has E y = β_g ρ with ρ = [x, v, 1], and
Cov y = V = Σ + Σ_k θ_gk D_k z zᵀ D_kᵀ, z = x (or [x, u]). Both are linear in (β_g; Σ, θ_g), the *local* coefficients.
With weights V⁻¹ (and ½ V⁻¹ ⊗ V⁻¹ for the squares) weighted least squares solves score = 0, where
  mean:        score V⁻¹ r ρᵀ,                           information V⁻¹ ⊗ ρ ρᵀ;
  covariance:  score ½ <W_p, L⁻¹ (r rᵀ - V) L⁻ᵀ>,       information ½ <W_p, W_q>, W_p = L⁻¹ (∂V/∂θ_p) L⁻ᵀ, V = L Lᵀ.
Residuals given x and v have mean zero and are uncorrelated in time, also in the closed loop, where v_t depends on
w_{t-1} but not on w_t: so the scores of different units are uncorrelated, whatever the law of Δ and w.
"""

import itertools
from typing import NamedTuple

import numpy as np

from perfcontrol.identification.transitions import Transitions

FLOOR = 1e-8  # of the mean squared residual: weights of noise that is singular stay finite


class Sums(NamedTuple):
    """score (U, P) and information (U, P, P) of every unit."""

    score: np.ndarray
    information: np.ndarray

    def by_group(self, group: np.ndarray, count: int) -> "Sums":
        """Summed over the units of each deployment."""
        total = Sums(*(np.zeros((count, *part.shape[1:])) for part in self))
        for into, part in zip(total, self, strict=True):
            np.add.at(into, group, part)
        return total


def symmetric_basis(n: int) -> np.ndarray:
    """E_ij for i ≤ j, (n(n+1)/2, n, n): a symmetric matrix is its upper triangle times this."""
    rows, columns = np.triu_indices(n)
    basis = np.zeros((len(rows), n, n))
    basis[np.arange(len(rows)), rows, columns] = 1
    basis[np.arange(len(rows)), columns, rows] = 1
    return basis


def upper(matrices: np.ndarray) -> np.ndarray:
    """The upper triangles, (..., n(n+1)/2)."""
    rows, columns = np.triu_indices(matrices.shape[-1])
    return matrices[..., rows, columns]


def isometric(matrices: np.ndarray) -> np.ndarray:
    """Upper triangles with off-diagonal entries times √2, so that their products are those of the matrices."""
    rows, columns = np.triu_indices(matrices.shape[-1])
    return matrices[..., rows, columns] * np.where(rows == columns, 1, np.sqrt(2))


def inverse_factors(V: np.ndarray, scale: float) -> np.ndarray:
    """L⁻¹ with L Lᵀ = V, after V has been lifted by a share of `scale`, the mean squared residual."""
    eye = np.eye(V.shape[-1])
    return np.linalg.inv(np.linalg.cholesky(V + FLOOR * max(scale, np.finfo(float).tiny) * eye))


def mean_sums(data: Transitions, residual: np.ndarray, whiten: np.ndarray) -> Sums:
    """Of the local mean coefficients β (n, q), flattened row by row."""
    regressors = data.regressors
    n, q = data.y.shape[1], regressors.shape[1]
    pairs_n, pairs_q = np.triu_indices(n), np.triu_indices(q)
    scores, informations = [], []
    for units, rows in data.pieces():
        W = np.swapaxes(whiten[rows], -1, -2) @ whiten[rows]
        weighted = np.einsum("tij,tj->ti", W, residual[rows])
        rho = regressors[rows]
        left, right = W[:, *pairs_n], rho[:, pairs_q[0]] * rho[:, pairs_q[1]]
        start = data.unit[units.start : units.stop + 1] - data.unit[units.start]
        for a, b in itertools.pairwise(start):
            scores.append((weighted[a:b].T @ rho[a:b]).ravel())
            informations.append(left[a:b].T @ right[a:b])
    compact = np.array(informations)
    full = np.empty((len(compact), n, n, q, q))
    for k, (i, j) in enumerate(zip(*pairs_n, strict=True)):
        block = np.empty((len(compact), q, q))
        block[:, *pairs_q] = compact[:, k]
        block[:, pairs_q[1], pairs_q[0]] = compact[:, k]
        full[:, i, j] = full[:, j, i] = block
    information = full.transpose(0, 1, 3, 2, 4).reshape(-1, n * q, n * q)
    return Sums(np.array(scores), information)


def covariance_sums(data: Transitions, residual: np.ndarray, whiten: np.ndarray, images: np.ndarray) -> Sums:
    """Of the local covariance coefficients (upper triangle of Σ, θ_1, ..., θ_k), at zero; images: D_k z, (N, k, n)."""
    n = data.y.shape[1]
    basis = symmetric_basis(n)
    scores, informations = [], []
    for units, rows in data.pieces():
        L = whiten[rows]
        noise = np.einsum("tia,pab,tjb->tpij", L, basis, L, optimize=True)
        a = np.einsum("tij,tkj->tki", L, images[rows])
        design = np.concatenate([isometric(noise), isometric(a[..., :, None] * a[..., None, :])], axis=1)
        w = np.einsum("tij,tj->ti", L, residual[rows])
        square = isometric(w[:, :, None] * w[:, None, :])
        per_row = np.einsum("tps,ts->tp", design, square) / 2
        start = data.unit[units.start : units.stop + 1] - data.unit[units.start]
        scores.append(np.add.reduceat(per_row, start[:-1], axis=0))
        for first, last in itertools.pairwise(start):
            flat = design[first:last].transpose(0, 2, 1).reshape(-1, design.shape[1])
            informations.append(flat.T @ flat / 2)
    return Sums(np.concatenate(scores), np.array(informations))
