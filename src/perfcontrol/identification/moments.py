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
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from perfcontrol.identification.transitions import Transitions

FLOOR = 1e-8  # of the mean squared residual: weights of noise that is singular stay finite


class Sums(NamedTuple):
    """score (U, P) of every unit; information (U, P, P) likewise, or summed over bins of units."""

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


def _kronecker_sums(data: Transitions, parts: Callable[[slice], tuple], bins: np.ndarray) -> Sums:
    """Scores target ⊗ right of every unit; information left ⊗ right rightᵀ summed over bins (U,) of units.

    parts: rows -> left (N, a, a) symmetric, target (N, a), right (N, q); coefficients (a, q), flattened row by row.
    """
    score, compact, pairs_a, pairs_q = [], {}, ([], []), ([], [])
    for units, rows in data.pieces():
        left, target, right = parts(rows)
        pairs_a, pairs_q = np.triu_indices(target.shape[1]), np.triu_indices(right.shape[1])
        left, squares = left[:, *pairs_a], right[:, pairs_q[0]] * right[:, pairs_q[1]]
        start = data.unit[units.start : units.stop + 1] - rows.start
        for unit, (first, last) in zip(range(units.start, units.stop), itertools.pairwise(start), strict=True):
            score.append((target[first:last].T @ right[first:last]).ravel())
            bin_ = int(bins[unit])
            compact[bin_] = compact.get(bin_, 0.0) + left[first:last].T @ squares[first:last]
    a, q = pairs_a[1][-1] + 1, pairs_q[1][-1] + 1
    full = np.zeros((int(bins.max()) + 1, a, a, q, q))
    for bin_, sums in compact.items():
        for i, j, block in zip(*pairs_a, sums, strict=True):
            full[bin_, i, j][pairs_q] = block
            full[bin_, i, j].T[pairs_q] = block
            full[bin_, j, i] = full[bin_, i, j]
    return Sums(np.array(score), full.transpose(0, 1, 3, 2, 4).reshape(-1, a * q, a * q))


def images_of(data: Transitions, directions: np.ndarray) -> np.ndarray:
    """D_k z for every transition, (N, k, n); z = x, or [x, u] where the directions have n+m columns."""
    return np.einsum("kip,tp->tki", directions, data.moved(directions.shape[-1]))


def covariances(data: Transitions, noise: np.ndarray, variance: np.ndarray, images: np.ndarray) -> np.ndarray:
    """V for every transition, (N, n, n), for variances (G, k)."""
    scaled = images * variance[data.row_group][:, :, None]
    return noise + np.einsum("tki,tkj->tij", scaled, images)


def mean_sums(data: Transitions, residual: np.ndarray, whiten: np.ndarray, bins: np.ndarray | None = None) -> Sums:
    """Of the local mean coefficients β (n, q), flattened row by row; information by unit, or by bins of units."""
    regressors = data.regressors

    def parts(rows: slice) -> tuple:
        W = np.swapaxes(whiten[rows], -1, -2) @ whiten[rows]
        return W, np.einsum("tij,tj->ti", W, residual[rows]), regressors[rows]

    return _kronecker_sums(data, parts, np.arange(len(data.group)) if bins is None else bins)


def operator_sums(data: Transitions, square: np.ndarray, whiten: np.ndarray, z: np.ndarray, bins: np.ndarray) -> Sums:
    """Of any covariance that is linear in z zᵀ: coefficients (i ≤ j; 1 and z_a z_b, a ≤ b), for squares (N, n, n);
    information by bins of units."""
    basis = symmetric_basis(square.shape[-1])

    def parts(rows: slice) -> tuple:
        L = whiten[rows]
        noise = isometric(np.einsum("tia,pab,tjb->tpij", L, basis, L, optimize=True))
        target = np.einsum("tps,ts->tp", noise, isometric(L @ square[rows] @ np.swapaxes(L, -1, -2))) / 2
        return noise @ np.swapaxes(noise, -1, -2) / 2, target, monomials(z[rows])

    return _kronecker_sums(data, parts, bins)


def monomials(z: np.ndarray) -> np.ndarray:
    """1 and z_a z_b, a ≤ b, (N, 1 + p(p+1)/2)."""
    return np.concatenate([np.ones((len(z), 1)), upper(z[:, :, None] * z[:, None, :])], axis=1)


def row_sums(data: Transitions, parts: Callable[[slice], tuple[np.ndarray, np.ndarray]], rows: int = 4000) -> Sums:
    """Of any linear model of whitened squares: rows -> design (N, P, s) and target (N, s), in isometric form."""
    scores, informations = [], []
    for units, part in data.pieces(rows):
        design, target = parts(part)
        start = data.unit[units.start : units.stop + 1] - part.start
        scores.append(np.add.reduceat(np.einsum("tps,ts->tp", design, target) / 2, start[:-1], axis=0))
        for first, last in itertools.pairwise(start):
            flat = design[first:last].transpose(0, 2, 1).reshape(-1, design.shape[1])
            informations.append(flat.T @ flat / 2)
    return Sums(np.concatenate(scores), np.array(informations))


def covariance_sums(data: Transitions, residual: np.ndarray, whiten: np.ndarray, images: np.ndarray) -> Sums:
    """Of the local covariance coefficients (upper triangle of Σ, θ_1, ..., θ_k), at zero; images: D_k z, (N, k, n)."""
    basis = symmetric_basis(data.y.shape[1])

    def parts(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        L = whiten[rows]
        noise = np.einsum("tia,pab,tjb->tpij", L, basis, L, optimize=True)
        a = np.einsum("tij,tkj->tki", L, images[rows])
        w = np.einsum("tij,tj->ti", L, residual[rows])
        design = np.concatenate([isometric(noise), isometric(a[..., :, None] * a[..., None, :])], axis=1)
        return design, isometric(w[:, :, None] * w[:, None, :])

    return row_sums(data, parts)
