"""The null hypothesis fitted: one mean, one noise and one perturbation law for every deployment."""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.estimate import moments
from perfcontrol.identification.location import jacobian
from perfcontrol.identification.moments import Sums, covariance_sums, images_of, mean_sums, operator_sums, upper
from perfcontrol.identification.operator import operator_fit
from perfcontrol.identification.transitions import Transitions


class Common(NamedTuple):
    """A common fit with scores (U, P) of every unit and information (G, P, P) of every deployment at it.

    mean: of the local mean coefficients. covariance: of noise and perturbations, `noise` (P,) marking the former and
    `theta` (P,) being their values. root (n, n): L with L Lᵀ the average residual covariance.
    """

    mean: Sums
    covariance: Sums
    theta: np.ndarray
    noise: np.ndarray
    root: np.ndarray


def common_fit(data: Transitions, directions: np.ndarray | None) -> Common:
    """With perturbations along `directions`, or of any covariance where that is None."""
    return _any_covariance(data) if directions is None else _along_directions(data, directions)


def _any_covariance(data: Transitions) -> Common:
    n = data.y.shape[1]
    q = n + data.v.shape[1] + 1
    fitted = operator_fit(data, jacobian(np.ones((len(data.policies), 1)), np.zeros(q, dtype=bool)))
    noise = np.zeros_like(fitted.theta, dtype=bool)
    noise[:, 0] = True
    return Common(
        mean_sums(data, fitted.location.residual(data), fitted.whiten, data.group),
        operator_sums(data, fitted.square - fitted.V, fitted.whiten, data.x, data.group),
        fitted.theta.ravel(),
        noise.ravel(),
        fitted.root,
    )


def _along_directions(data: Transitions, directions: np.ndarray) -> Common:
    n, ones = data.y.shape[1], np.ones((len(data.policies), 1))
    fitted = moments(data, directions, ones, ones, np.zeros(n + data.v.shape[1] + 1, dtype=bool))
    residual, whiten = fitted.residual(data), fitted.whiten()
    local = covariance_sums(data, residual, whiten, images_of(data, directions))
    theta = np.concatenate([upper(fitted.noise), fitted.scales[:, 0] ** 2])
    average = residual.T @ residual / len(residual)
    return Common(
        mean_sums(data, fitted.location.residual(data), whiten, data.group),
        Sums(
            local.score - np.einsum("upq,q->up", local.information, theta),
            local.by_group(data.group, len(data.policies)).information,
        ),
        theta,
        np.arange(len(theta)) < n * (n + 1) // 2,
        np.linalg.cholesky(average + 1e-12 * np.trace(average) * np.eye(n)),
    )
