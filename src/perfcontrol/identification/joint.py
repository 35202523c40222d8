"""Noise, scales and estimated directions together, by Fisher scoring: what makes their standard errors joint ones.

V_t = Σ + Σ_k (c_k · f_g)² D_k z zᵀ D_kᵀ. A direction has norm one and moves on its sphere, so that it does not compete
with its scale. Directions whose scales are proportional are known up to rotation only; the least step leaves that be.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from perfcontrol.identification.blocks import Block, pseudo_inverse
from perfcontrol.identification.covariance import semidefinite
from perfcontrol.identification.moments import (
    Sums,
    covariances,
    images_of,
    inverse_factors,
    isometric,
    row_sums,
    symmetric_basis,
    upper,
)
from perfcontrol.identification.transitions import Transitions

STEPS = 50
SETTLED = 1e-6  # of the log-likelihood: what a full step would gain
STALLED = 1e-4  # what a damped step gained
LEAST, MOST = 1e-3, 1e6  # damping of a step, in shares of the information


class Joint(NamedTuple):
    """noise (n, n), scales (k, Q), directions (k, n, p), and the block of all their coordinates.

    tangent (k, n p, n p - 1): a direction's coordinates d stand for D + tangent d, brought back to norm one.
    """

    noise: np.ndarray
    scales: np.ndarray
    directions: np.ndarray
    tangent: np.ndarray
    block: Block

    def at(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Noise, scales and directions for other values of the block's coordinates."""
        return _unpacked(values, self.noise, self.scales, self.directions, self.tangent)

    def noise_influence(self) -> np.ndarray:
        """Of every unit on the noise's upper triangle, as `Block.influence`, (U, n(n+1)/2)."""
        return self.block.influence[:, : len(upper(self.noise))]

    def scale_influence(self) -> np.ndarray:
        """Likewise on the scales, (U, k, Q)."""
        first = len(upper(self.noise))
        influence = self.block.influence[:, first : first + self.scales.size]
        return influence.reshape(len(influence), *self.scales.shape)

    def direction_influence(self) -> np.ndarray:
        """Likewise on the directions, (U, k, n, p); zero where they have no coordinates."""
        k, _, width = self.tangent.shape
        influence = self.block.influence[:, self.block.influence.shape[1] - k * width :]
        along = np.einsum("kdv,ukv->ukd", self.tangent, influence.reshape(len(influence), k, width))
        return along.reshape(len(influence), *self.directions.shape)


def joint_scoring(
    data: Transitions,
    residual: np.ndarray,
    features: np.ndarray,
    start: tuple[np.ndarray, np.ndarray, np.ndarray],
    free: bool,
) -> Joint:
    """From (noise, scales, directions); features (G, Q). Directions that are not `free` have no coordinates."""
    scale = float(np.mean(residual**2))
    (noise, scales, directions), damping, gained = start, 0.0, np.inf
    V, reached = _likelihood(data, residual, features, noise, scales, directions, scale)
    for _ in range(STEPS):
        tangent, values = _coordinates(noise, scales, directions, free)
        sums = _sums(data, residual, V, features, scales, directions, tangent, scale, data.group)
        score, information = sums.score.sum(axis=0), sums.information.sum(axis=0)
        stalled = damping > 0 and gained < STALLED  # as where the noise is singular, and its score does not vanish
        if stalled or score @ pseudo_inverse(information) @ score < SETTLED:
            break
        while damping < MOST:
            move = pseudo_inverse(information + damping * np.diag(np.diag(information))) @ score
            trial = _unpacked(values + move, noise, scales, directions, tangent)
            V_trial, value = _likelihood(data, residual, features, *trial, scale)
            if value > reached:
                break
            damping = max(10 * damping, LEAST)
        else:
            break
        damping = damping / 10 if damping > LEAST else 0.0
        (noise, scales, directions), V, reached, gained = trial, V_trial, value, value - reached
    tangent, values = _coordinates(noise, scales, directions, free)
    units = np.arange(len(data.group))
    sums = _sums(data, residual, V, features, scales, directions, tangent, scale, units)
    return Joint(noise, scales, directions, tangent, Block(values, *sums))


def _coordinates(
    noise: np.ndarray, scales: np.ndarray, directions: np.ndarray, free: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Tangents, and the values of a block's coordinates."""
    tangent = _tangents(directions, free)
    return tangent, np.concatenate([upper(noise), scales.ravel(), np.zeros(len(tangent) * tangent.shape[2])])


def _tangents(directions: np.ndarray, free: bool) -> np.ndarray:
    """Orthonormal bases of the matrices at right angles to each direction, (k, n p, n p - 1); empty if not `free`."""
    size = directions.shape[1] * directions.shape[2]
    if not free or len(directions) == 0:
        return np.zeros((len(directions), size, 0))
    return np.stack([linalg.null_space(D.reshape(1, -1)) for D in directions])


def _unpacked(
    values: np.ndarray, noise: np.ndarray, scales: np.ndarray, directions: np.ndarray, tangent: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(noise)
    s = n * (n + 1) // 2
    moved = values[s + scales.size :].reshape(len(directions), tangent.shape[-1])
    D = directions
    if tangent.shape[-1]:
        D = directions + np.einsum("kuv,kv->ku", tangent, moved).reshape(directions.shape)
        D = D / np.linalg.norm(D, axis=(1, 2))[:, None, None]
    return semidefinite(values[:s], n), values[s : s + scales.size].reshape(scales.shape), D


def _likelihood(
    data: Transitions,
    residual: np.ndarray,
    features: np.ndarray,
    noise: np.ndarray,
    scales: np.ndarray,
    directions: np.ndarray,
    scale: float,
) -> tuple[np.ndarray, float]:
    """V and the Gaussian log-likelihood, up to a constant."""
    V = covariances(data, noise, (features @ scales.T) ** 2, images_of(data, directions))
    whiten = inverse_factors(V, scale)
    w = np.einsum("tij,tj->ti", whiten, residual)
    logs = np.log(np.einsum("tii->ti", whiten)).sum()
    return V, float(logs - np.sum(w**2) / 2)


def _sums(
    data: Transitions,
    residual: np.ndarray,
    V: np.ndarray,
    features: np.ndarray,
    scales: np.ndarray,
    directions: np.ndarray,
    tangent: np.ndarray,
    scale: float,
    bins: np.ndarray,
) -> Sums:
    """Of noise, scales and tangents; information by bins of units. ∂V/∂D_k,ip: a multiple of sym(e_i (D_k z)ᵀ) z_p."""
    (n, p), free = directions.shape[1:], tangent.shape[-1] > 0
    basis, images, eta = symmetric_basis(n), images_of(data, directions), features @ scales.T
    z, whiten, group = data.moved(p), inverse_factors(V, scale), data.row_group

    def design(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        L, g = whiten[rows], group[rows]
        noise = np.einsum("tia,pab,tjb->tpij", L, basis, L, optimize=True)
        a = np.einsum("tij,tkj->tki", L, images[rows])
        outer = isometric(a[..., :, None] * a[..., None, :])  # (t, k, s)
        by_scale = 2 * (eta[g][:, :, None] * features[g][:, None, :])[..., None] * outer[:, :, None, :]
        parts = [isometric(noise), by_scale.reshape(len(g), -1, outer.shape[-1])]
        if free:
            side = np.swapaxes(L, 1, 2)[:, None, :, :, None] * (a * eta[g][:, :, None] ** 2)[:, :, None, None, :]
            sides = isometric(side + np.swapaxes(side, -1, -2))  # (t, k, i, s)
            entries = sides[:, :, :, None, :] * z[rows][:, None, None, :, None]
            parts.append(entries.reshape(len(g), -1, outer.shape[-1]))
        r = residual[rows]
        target = isometric(L @ (r[:, :, None] * r[:, None, :] - V[rows]) @ np.swapaxes(L, -1, -2))
        return np.concatenate(parts, axis=1), target

    sums = row_sums(data, design, bins)
    if not free:
        return sums
    onto = linalg.block_diag(np.eye(len(basis) + scales.size), *tangent)
    return Sums(sums.score @ onto, onto.T @ sums.information @ onto)
