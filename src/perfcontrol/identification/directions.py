"""Directions of the perturbations from logs: a covariance operator of low rank, the rank that predicts best.

The squares tell the operator X -> E[(Δ-Θ) X (Δ-Θ)ᵀ] on symmetric X, and no more: many laws of Δ share it. Here it is
written as Σ_k θ_gk D_k X D_kᵀ with few directions of norm one, and variances θ_gk ≥ 0 for each deployment g: nonlinear
least squares on the sums of `moments.operator_sums`.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from perfcontrol.identification.covariance import levenberg
from perfcontrol.identification.moments import Sums, operator_sums
from perfcontrol.identification.operator import least_solution, operator_fit
from perfcontrol.identification.transitions import Transitions

LARGEST = 4  # rank tried
FOLDS = 4


class LowRank(NamedTuple):
    """directions (k, n, p) of Frobenius norm one; local (G, P): the coefficients of the operator with them."""

    directions: np.ndarray
    local: np.ndarray


def product_map(n: int, p: int) -> np.ndarray:
    """L (s, s_p, n p, n p): the coefficients of D z zᵀ Dᵀ, (i ≤ j; a ≤ b), are Σ L D_ia D_jb."""
    rows, columns = np.triu_indices(n)
    first, second = np.triu_indices(p)
    L = np.zeros((len(rows), len(first), n, p, n, p))
    for r, (i, j) in enumerate(zip(rows, columns, strict=True)):
        for c, (a, b) in enumerate(zip(first, second, strict=True)):
            L[r, c, i, a, j, b] += 1
            if a != b:
                L[r, c, i, b, j, a] += 1
    return L.reshape(len(rows), len(first), n * p, n * p)


def low_rank(totals: Sums, n: int, p: int, rank: int) -> LowRank:
    """The best fit with `rank` directions; totals by deployment."""
    groups = len(totals.score)
    s, L = n * (n + 1) // 2, product_map(n, p)
    width = 1 + L.shape[1]
    noise = np.zeros((s, s * width))
    noise[np.arange(s), np.arange(s) * width] = 1

    def local(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        D = parameters[s : s + rank * n * p].reshape(rank, n * p)
        eta = parameters[s + rank * n * p :].reshape(groups, rank)
        half = np.einsum("rcuv,kv->rcku", L, D)
        whole = np.einsum("rcku,ku->rck", half, D)
        slope = half + np.einsum("rcuv,ku->rckv", L, D)
        theta, jacobian = np.zeros((groups, s, width)), np.zeros((groups, s, width, len(parameters)))
        theta[:, :, 1:] = np.einsum("gk,rck->grc", eta**2, whole)
        theta = theta.reshape(groups, -1) + parameters[:s] @ noise
        jacobian[:, :, 0, :s] = np.eye(s)
        by_D = np.einsum("gk,rcku->grcku", eta**2, slope).reshape(groups, s, width - 1, rank * n * p)
        jacobian[:, :, 1:, s : s + rank * n * p] = by_D
        for g in range(groups):
            jacobian[g, :, 1:, s + rank * n * p + g * rank + np.arange(rank)] = np.moveaxis(2 * eta[g] * whole, 2, 0)
        return theta, jacobian.reshape(groups, s * width, len(parameters))

    start = _start(totals, n, p, rank)
    found = levenberg(start, local, totals)
    D = found[s : s + rank * n * p].reshape(rank, n, p)
    size = np.linalg.norm(D, axis=(1, 2))
    return LowRank(D / np.where(size > 0, size, 1)[:, None, None], local(found)[0])


def _start(totals: Sums, n: int, p: int, rank: int) -> np.ndarray:
    """From the pooled operator without structure: its leading eigenvectors as a matrix on vec Δ."""
    s = n * (n + 1) // 2
    theta = least_solution(totals.information.sum(axis=0), totals.score.sum(axis=0)).reshape(s, -1)
    matrix = np.zeros((n, p, n, p))
    rows, columns = np.triu_indices(n)
    first, second = np.triu_indices(p)
    for r, (i, j) in enumerate(zip(rows, columns, strict=True)):
        for c, (a, b) in enumerate(zip(first, second, strict=True)):
            value = theta[r, 1 + c] / (1 if a == b else 2)
            for u, v in ((i, j), (j, i)):
                matrix[u, a, v, b] = matrix[u, b, v, a] = value
    values, vectors = np.linalg.eigh(matrix.reshape(n * p, n * p))
    leading = np.argsort(values)[::-1][:rank]
    root = np.sqrt(np.maximum(values[leading], 0.01 * max(values.max(), 1e-12)))
    D = (vectors[:, leading] * root).T
    return np.concatenate([theta[:, 0], D.ravel(), np.ones(len(totals.score) * rank)])


def estimated_directions(data: Transitions, jacobian: np.ndarray, rank: int | None, seed: np.ndarray) -> np.ndarray:
    """Directions (k, n, n) acting on the state; `jacobian` as in `estimate`, `seed` of the held-out episodes."""
    n, groups = data.x.shape[1], len(data.policies)
    fitted = operator_fit(data, jacobian)
    bins, size = _folds(data, seed) * groups + data.group, FOLDS * groups
    sums = operator_sums(data, fitted.square, fitted.whiten, data.x, bins)
    information = np.zeros((size, *sums.information.shape[1:]))
    information[: len(sums.information)] = sums.information  # the last bins may hold no unit
    folds = Sums(np.zeros((size, sums.score.shape[1])), information)
    np.add.at(folds.score, bins, sums.score)
    if rank is None:
        rank = best_rank(folds, groups, n, n)
    if rank == 0:
        return np.zeros((0, n, n))
    return canonical(low_rank(_total(folds, groups), n, n, rank).directions)


def _folds(data: Transitions, seed: np.ndarray) -> np.ndarray:
    """The fold of every unit, as many of each deployment in each."""
    generator, fold = np.random.default_rng(seed), np.empty(len(data.group), dtype=int)
    for g in range(len(data.policies)):
        members = np.flatnonzero(data.group == g)
        fold[generator.permutation(members)] = np.arange(len(members)) % FOLDS
    return fold


def best_rank(folds: Sums, groups: int, n: int, p: int) -> int:
    """The rank from which on one more direction does not predict held-out episodes better; folds (FOLDS G) of sums."""
    best, highest = 0, -np.inf
    for rank in range(min(LARGEST, n * p) + 1):
        score = 0.0
        for train, test in _splits(folds, groups):
            local = low_rank(train, n, p, rank).local
            score += float(np.sum((test.score - np.einsum("gij,gj->gi", test.information, local) / 2) * local))
        if score <= highest:
            break
        best, highest = rank, score
    return best


def _total(folds: Sums, groups: int) -> Sums:
    return Sums(*(part.reshape(FOLDS, groups, *part.shape[1:]).sum(axis=0) for part in folds))


def _splits(folds: Sums, groups: int) -> Iterator[tuple[Sums, Sums]]:
    total = _total(folds, groups)
    for fold in range(FOLDS):
        test = Sums(*(part[fold * groups : (fold + 1) * groups] for part in folds))
        yield Sums(total.score - test.score, total.information - test.information), test


def canonical(directions: np.ndarray) -> np.ndarray:
    """With the largest entry of each positive: the sign of a direction means nothing."""
    flat = directions.reshape(len(directions), -1)
    sign = np.sign(flat[np.arange(len(flat)), np.argmax(np.abs(flat), axis=1)])
    return directions * sign[:, None, None]
