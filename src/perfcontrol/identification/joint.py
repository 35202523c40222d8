"""Noise, scales and estimated directions together, by Fisher scoring: what makes their standard errors joint ones.

V_t = Σ + Σ_k (c_k · f_g)² D_k z zᵀ D_kᵀ. A direction has norm one and moves on its sphere, so that it does not compete
with its scale. Directions whose scales are proportional are known up to rotation only; the least step leaves that be.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from perfcontrol.identification.blocks import Block
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

STEPS = 12
SETTLED = 1e-6
HALVINGS = 6


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

    def scale_covariance(self) -> np.ndarray:
        """Of the scales, (k, Q, k, Q)."""
        first = len(self.noise) * (len(self.noise) + 1) // 2
        part = slice(first, first + self.scales.size)
        return self.block.covariance()[part, part].reshape(2 * self.scales.shape)

    def direction_errors(self) -> np.ndarray:
        """Standard errors of the directions, (k, n, p)."""
        k, _, width = self.tangent.shape
        first = len(self.block.values) - k * width
        covariance = self.block.covariance()[first:, first:].reshape(k, width, k, width)
        variance = np.einsum("kuv,kvkw,kuw->ku", self.tangent, covariance, self.tangent)
        return np.sqrt(np.maximum(variance, 0)).reshape(self.directions.shape)


def joint_scoring(
    data: Transitions,
    residual: np.ndarray,
    features: np.ndarray,
    start: tuple[np.ndarray, np.ndarray, np.ndarray],
    free: bool,
) -> Joint:
    """From (noise, scales, directions); features (G, Q). Directions that are not `free` have no coordinates."""
    scale = float(np.mean(residual**2))
    noise, scales, directions = start
    V, reached = _likelihood(data, residual, features, noise, scales, directions, scale)
    step = 0
    while True:
        tangent = _tangents(directions, free)
        sums = _sums(data, residual, V, features, scales, directions, tangent, scale)
        block = Block(np.concatenate([upper(noise), scales.ravel(), np.zeros(len(tangent) * tangent.shape[2])]), *sums)
        here = Joint(noise, scales, directions, tangent, block)
        score = sums.score.sum(axis=0)
        move = block.bread() @ score
        step += 1
        if step > STEPS or score @ move < SETTLED:
            return here
        for _ in range(HALVINGS):
            trial = here.at(block.values + move)
            V_trial, value = _likelihood(data, residual, features, *trial, scale)
            if value > reached:
                break
            move = move / 2
        else:
            return here
        (noise, scales, directions), V, reached = trial, V_trial, value


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
) -> Sums:
    n, p = directions.shape[1:]
    basis, images, eta = symmetric_basis(n), images_of(data, directions), features @ scales.T
    z = data.moved(p)
    whiten, group = inverse_factors(V, scale), data.row_group
    axes = tangent.reshape(len(directions), n, p, tangent.shape[-1])

    def design(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        L, g = whiten[rows], group[rows]
        noise = np.einsum("tia,pab,tjb->tpij", L, basis, L, optimize=True)
        a = np.einsum("tij,tkj->tki", L, images[rows])
        outer = isometric(a[..., :, None] * a[..., None, :])  # (t, k, s)
        by_scale = 2 * np.einsum("tk,tq,tks->tkqs", eta[g], features[g], outer).reshape(len(g), -1, outer.shape[-1])
        d = np.einsum("tij,kjpv,tp->tkvi", L, axes, z[rows], optimize=True) * eta[g][:, :, None, None] ** 2
        both = d[..., :, None] * a[:, :, None, None, :]
        by_direction = isometric(both + np.swapaxes(both, -1, -2)).reshape(len(g), -1, outer.shape[-1])
        r = residual[rows]
        target = isometric(L @ (r[:, :, None] * r[:, None, :] - V[rows]) @ np.swapaxes(L, -1, -2))
        return np.concatenate([isometric(noise), by_scale, by_direction], axis=1), target

    return row_sums(data, design)
