"""Covariances from squared residuals: the noise, and the variance along each direction as a function of the policy.

Weighted least squares on the local coefficients θ_g = (Σ, variances): minimise Σ_g ½ θ_gᵀ I_g θ_g - T_gᵀ θ_g, with T_g
and I_g the sums of `moments.covariance_sums` over deployment g. The variances are free, or squares of scales that are
linear in features of the policy; repeated with the weights of the last fit this is Fisher scoring for the Gaussian
likelihood, which is consistent under any law with these two moments.
"""

import itertools
from collections.abc import Callable

import numpy as np

from perfcontrol.identification.moments import Sums, symmetric_basis, upper

PATTERNS = 8  # deployments up to which every pattern of signs of a scale is tried
CROSSING = 9.0  # how much better a scale must fit, in squared standard errors, before it is believed to cross zero
STEPS = 100
SETTLED = 1e-8  # of the log-likelihood


def variances(totals: Sums, n: int) -> np.ndarray:
    """Σ in common and free variances θ_g ≥ 0: the local coefficients, (G, P)."""
    count, size = totals.score.shape
    noise = n * (n + 1) // 2
    free = size - noise
    width = noise + count * free
    matrix, right = np.zeros((width, width)), np.zeros(width)
    for g in range(count):
        index = np.concatenate([np.arange(noise), noise + g * free + np.arange(free)])
        matrix[np.ix_(index, index)] += totals.information[g]
        right[index] += totals.score[g]
    bounds = np.full(width, -np.inf)
    bounds[noise:] = 0
    solution = _bounded(matrix, right, bounds)
    theta = np.empty((count, size))
    theta[:, :noise] = upper(semidefinite(solution[:noise], n))
    theta[:, noise:] = solution[noise:].reshape(count, free)
    return theta


def _bounded(matrix: np.ndarray, right: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """argmin ½ sᵀ matrix s - rightᵀ s over s ≥ bounds; the least one where it is not unique."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * scale * scale[:, None])
    kept = values > 1e-12 * values.max(initial=0.0)
    root = np.sqrt(values[kept])
    design, target = root[:, None] * vectors[:, kept].T, vectors[:, kept].T @ (right * scale) / root
    free = np.linalg.lstsq(design, target, rcond=None)[0]
    if np.any(free < bounds):
        from scipy.optimize import lsq_linear  # here alone: its import takes 0.2 s

        free = lsq_linear(design, target, (bounds, np.inf)).x
    return free * scale


def semidefinite(triangle: np.ndarray, n: int) -> np.ndarray:
    """The nearest positive semidefinite matrix to the symmetric one with this upper triangle."""
    values, vectors = np.linalg.eigh(np.tensordot(triangle, symmetric_basis(n), axes=1))
    return (vectors * np.maximum(values, 0)) @ vectors.T


def scale_fit(totals: Sums, n: int, features: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ and scales (k, Q), variance_gk = (scales_k · features_g)², from the free variances `theta` as a start."""
    noise, width = n * (n + 1) // 2, features.shape[1]
    count = theta.shape[1] - noise
    start = [_start(theta[:, noise + k], totals, noise + k, features) for k in range(count)]

    def local(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = features @ p[noise:].reshape(count, width).T
        theta = np.concatenate([np.broadcast_to(p[:noise], (len(features), noise)), values**2], axis=1)
        jacobian = np.zeros((len(features), theta.shape[1], len(p)))
        jacobian[:, :noise, :noise] = np.eye(noise)
        for k in range(count):
            columns = noise + k * width + np.arange(width)
            jacobian[:, noise + k, columns] = 2 * values[:, k, None] * features
        return theta, jacobian

    found = levenberg(np.concatenate([theta[0, :noise], *start]), local, totals)
    return semidefinite(found[:noise], n), found[noise:].reshape(count, width)


def _start(variance: np.ndarray, totals: Sums, index: int, features: np.ndarray) -> np.ndarray:
    """Scales that fit the roots of the free variances best, over the patterns of signs (a scale may cross zero)."""
    information = np.maximum(totals.information[:, index, index], 1e-300)
    root = np.sqrt(np.maximum(variance, 0.1 / np.sqrt(information)))
    weight = np.sqrt(information) * root  # of the root, by the delta rule
    few = len(variance) <= PATTERNS and features.shape[1] > 1
    patterns = itertools.product((1.0, -1.0), repeat=len(variance) - 1) if few else [(1.0,) * (len(variance) - 1)]
    best, least = np.zeros(features.shape[1]), np.inf
    for pattern in patterns:  # the first has no change of sign
        signed = root * np.array([1.0, *pattern])
        scale = np.linalg.lstsq(weight[:, None] * features, weight * signed, rcond=1e-10)[0]
        misfit = float(np.sum(information * (variance - (features @ scale) ** 2) ** 2))
        misfit += CROSSING if np.any(np.diff(pattern, prepend=1.0)) else 0.0
        if misfit < least * (1 - 1e-9):
            best, least = scale, misfit
    return best


def levenberg(parameters: np.ndarray, local: Callable, totals: Sums) -> np.ndarray:
    """Minimise Σ_g ½ θ_gᵀ I_g θ_g - T_gᵀ θ_g, θ and its jacobian being local(parameters): Gauss-Newton, damped."""

    def objective(theta: np.ndarray) -> float:
        return float(
            np.sum(np.einsum("gij,gj->gi", totals.information, theta) * theta) / 2 - np.sum(totals.score * theta)
        )

    damping = 1e-8
    theta, jacobian = local(parameters)
    value = objective(theta)
    for _ in range(STEPS):
        through = totals.information @ jacobian
        gradient = np.einsum("gip,gi->p", jacobian, totals.score) - np.einsum("gip,gi->p", through, theta)
        matrix = np.einsum("gip,giq->pq", jacobian, through, optimize=True)
        diagonal = np.maximum(np.diag(matrix), 1e-12 * np.max(np.diag(matrix), initial=1e-300))
        while True:
            step = np.linalg.solve(matrix + damping * np.diag(diagonal), gradient)
            theta_trial, jacobian_trial = local(parameters + step)
            reached = objective(theta_trial)
            if reached <= value or damping > 1e8:
                break
            damping *= 10
        if reached > value:
            break
        gained = value - reached
        parameters, theta, jacobian, value = parameters + step, theta_trial, jacobian_trial, reached
        damping = max(damping / 10, 1e-10)
        if float(gradient @ step) < SETTLED and gained < SETTLED:
            break
    return parameters
