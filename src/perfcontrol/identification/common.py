"""The null hypothesis fitted: one mean, one noise and one perturbation law for every deployment."""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.directions import low_rank
from perfcontrol.identification.estimate import moments
from perfcontrol.identification.location import Location, jacobian
from perfcontrol.identification.moments import Sums, covariance_sums, images_of, mean_sums, operator_sums, upper
from perfcontrol.identification.operator import operator_fit
from perfcontrol.identification.transitions import Transitions

RANK = 2  # of the covariance whose size is tested: fewer numbers than the operator's, and less noise in them


class Common(NamedTuple):
    """A common fit with scores (U, P) of every unit and information (G, P, P) of every deployment at it.

    mean: of the local mean coefficients. covariance: of noise and perturbations. noise (P,), perturbation (P,): the
    fitted coefficients of the latter, each zero where the other has its place (`noise_entries` tells which), the
    perturbations as a covariance of low rank. root (n, n): L with L Lᵀ the average residual covariance.
    """

    mean: Sums
    covariance: Sums
    noise: np.ndarray
    perturbation: np.ndarray
    noise_entries: np.ndarray
    root: np.ndarray
    location: Location


def common_fit(data: Transitions, directions: np.ndarray | None) -> Common:
    """With perturbations along `directions`, or of any covariance where that is None."""
    return _any_covariance(data) if directions is None else _along_directions(data, directions)


def _any_covariance(data: Transitions) -> Common:
    n = data.y.shape[1]
    fitted = operator_fit(data, jacobian(np.ones((len(data.policies), 1)), _nothing_reacts(data)))
    totals = operator_sums(data, fitted.square, fitted.whiten, data.x, np.zeros(len(data.group), dtype=int))
    totals = Sums(totals.score.sum(axis=0, keepdims=True), totals.information)
    noise = np.zeros_like(fitted.theta)
    noise[:, 0] = fitted.theta[:, 0]
    perturbation = low_rank(totals, n, n, min(RANK, n * n)).local.reshape(noise.shape).copy()
    perturbation[:, 0] = 0
    return Common(
        mean_sums(data, fitted.location.residual(data), fitted.whiten, data.group),
        operator_sums(data, fitted.square - fitted.V, fitted.whiten, data.x, data.group),
        noise.ravel(),
        perturbation.ravel(),
        np.broadcast_to(np.arange(noise.shape[1]) == 0, noise.shape).ravel(),
        fitted.root,
        fitted.location,
    )


def _along_directions(data: Transitions, directions: np.ndarray) -> Common:
    n, ones = data.y.shape[1], np.ones((len(data.policies), 1))
    fitted = moments(data, directions, ones, ones, _nothing_reacts(data))
    residual, whiten = fitted.residual(data), fitted.whiten()
    local = covariance_sums(data, residual, whiten, images_of(data, directions))
    noise, variance = upper(fitted.noise), fitted.scales[:, 0] ** 2
    theta = np.concatenate([noise, variance])
    average = residual.T @ residual / len(residual)
    return Common(
        mean_sums(data, fitted.location.residual(data), whiten, data.group),
        Sums(
            local.score - np.einsum("upq,q->up", local.information, theta),
            local.by_group(data.group, len(data.policies)).information,
        ),
        np.concatenate([noise, np.zeros_like(variance)]),
        np.concatenate([np.zeros_like(noise), np.maximum(variance, 1e-3 * variance.max(initial=1e-300))]),
        np.arange(len(theta)) < len(noise),
        np.linalg.cholesky(average + 1e-12 * np.trace(average) * np.eye(n)),
        fitted.location,
    )


def _nothing_reacts(data: Transitions) -> np.ndarray:
    return np.zeros(data.x.shape[1] + data.v.shape[1] + 1, dtype=bool)
