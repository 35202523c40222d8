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
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from perfcontrol.identification.transitions import Transitions

WIDE = 4000  # transitions worked on at a time, where each has a design of many numbers
FLOOR = 1e-8  # of the mean squared residual: weights of noise that is singular stay finite


class Sums(NamedTuple):
    """score (U, P) of every unit; information (U, P, P) likewise, or summed over bins of units."""

    score: np.ndarray
    information: np.ndarray

    def by_group(self, group: np.ndarray, count: int) -> "Sums":
        """Both summed over the units of each deployment."""
        return Sums(*(_grouped(part, group, count) for part in self))

    def score_by_group(self, group: np.ndarray, count: int) -> "Sums":
        """Scores summed over the units of each deployment; information was by deployment from the start."""
        return self._replace(score=_grouped(self.score, group, count))


def _grouped(part: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    total = np.zeros((count, *part.shape[1:]))
    np.add.at(total, group, part)
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


def _runs(data: Transitions, units: slice, bins: np.ndarray) -> Iterator[tuple[int, slice]]:
    """Neighbours of one bin (U,) among some units: the bin, and their rows counted from the first of all."""
    own = bins[units]
    first = units.start + np.flatnonzero(np.diff(own, prepend=own[0] - 1))
    start = data.unit[np.append(first, units.stop)] - data.unit[units.start]
    for bin_, (begin, end) in zip(bins[first], itertools.pairwise(start), strict=True):
        yield int(bin_), slice(int(begin), int(end))


def _unit_sums(data: Transitions, units: slice, values: np.ndarray) -> np.ndarray:
    """Summed over the rows of each of some units."""
    return np.add.reduceat(values, data.unit[units] - data.unit[units.start], axis=0)


def _kronecker_sums(data: Transitions, parts: Callable[[slice], tuple], bins: np.ndarray) -> Sums:
    """Scores target ⊗ right of every unit; information left ⊗ right rightᵀ summed over bins (U,) of units.

    parts: rows -> left (N, a, a) symmetric, target (N, a), right (N, q); coefficients (a, q), flattened row by row.
    """
    score, compact = [], {}
    for units, rows in data.pieces(WIDE):
        left, target, right = parts(rows)
        score.append(_unit_sums(data, units, target[:, :, None] * right[:, None, :]))
        left, squares = upper(left), upper(right[:, :, None] * right[:, None, :])
        for bin_, run in _runs(data, units, bins):
            compact[bin_] = compact.get(bin_, 0.0) + left[run].T @ squares[run]
    scores = np.concatenate(score)
    by_a, by_q = _pair_index(scores.shape[1]), _pair_index(scores.shape[2])
    packed = np.zeros((int(bins.max()) + 1, int(by_a.max()) + 1, int(by_q.max()) + 1))
    for bin_, sums in compact.items():
        packed[bin_] = sums
    information = packed[:, by_a[:, None, :, None], by_q[None, :, None, :]]
    scores = scores.reshape(len(scores), -1)
    return Sums(scores, information.reshape(len(packed), *2 * scores.shape[1:]))


def _pair_index(n: int) -> np.ndarray:
    """Where each entry of a symmetric matrix stands in its upper triangle, (n, n)."""
    index = np.zeros((n, n), dtype=int)
    index[np.triu_indices(n)] = np.arange(n * (n + 1) // 2)
    return np.maximum(index, index.T)


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


def row_sums(
    data: Transitions, parts: Callable[[slice], tuple[np.ndarray, np.ndarray]], bins: np.ndarray | None = None
) -> Sums:
    """Of any linear model of whitened squares: rows -> design (N, P, s) and target (N, s), in isometric form;
    information by unit, or by bins of units."""
    bins, scores, found = np.arange(len(data.group)) if bins is None else bins, [], {}
    for units, rows in data.pieces(WIDE):
        design, target = parts(rows)
        scores.append(_unit_sums(data, units, np.einsum("tps,ts->tp", design, target) / 2))
        flat = np.ascontiguousarray(design.transpose(0, 2, 1))
        for bin_, run in _runs(data, units, bins):
            part = flat[run].reshape(-1, flat.shape[2])
            found[bin_] = found.get(bin_, 0.0) + part.T @ part / 2
    return Sums(np.concatenate(scores), np.array([found[bin_] for bin_ in range(int(bins.max()) + 1)]))


def covariance_sums(
    data: Transitions, residual: np.ndarray, whiten: np.ndarray, images: np.ndarray, bins: np.ndarray | None = None
) -> Sums:
    """Of the local covariance coefficients (upper triangle of Σ, θ_1, ..., θ_k), at zero; images: D_k z, (N, k, n);
    information by unit, or by bins of units."""
    basis = symmetric_basis(data.y.shape[1])

    def parts(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        L = whiten[rows]
        noise = np.einsum("tia,pab,tjb->tpij", L, basis, L, optimize=True)
        a = np.einsum("tij,tkj->tki", L, images[rows])
        w = np.einsum("tij,tj->ti", L, residual[rows])
        design = np.concatenate([isometric(noise), isometric(a[..., :, None] * a[..., None, :])], axis=1)
        return design, isometric(w[:, :, None] * w[:, None, :])

    return row_sums(data, parts, bins)
