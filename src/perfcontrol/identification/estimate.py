"""Mean and covariance together: weighted least squares for each, with weights from the other, until both rest."""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.blocks import Block
from perfcontrol.identification.covariance import Spread, scale_fit, variances
from perfcontrol.identification.location import Location, jacobian, least_squares, reweighted
from perfcontrol.identification.moments import Sums, covariance_sums, inverse_factors, mean_sums, upper
from perfcontrol.identification.transitions import Transitions

ROUNDS = 12
SETTLED = 1e-7


class Moments(NamedTuple):
    """The estimates and, unit by unit, what they rest on."""

    location: Location
    spread: Spread
    mean: Block  # the free coefficients of the location, row by row
    covariance: Block  # upper triangle of Σ, then the scales row by row
    variances: np.ndarray  # (G, k)


def images_of(data: Transitions, directions: np.ndarray) -> np.ndarray:
    """D_k z for every transition, (N, k, n); z = x, or [x, u] where the directions have n+m columns."""
    n = data.x.shape[1]
    z = data.x if directions.shape[-1] == n else np.concatenate([data.x, data.v - data.x @ data.gain.T], axis=1)
    return np.einsum("kip,tp->tki", directions, z)


def covariances(data: Transitions, noise: np.ndarray, variance: np.ndarray, images: np.ndarray) -> np.ndarray:
    """V for every transition, (N, n, n), for variances (G, k)."""
    scaled = images * variance[data.row_group][:, :, None]
    return noise + np.einsum("tki,tkj->tij", scaled, images)


def estimate(
    data: Transitions,
    directions: np.ndarray,
    mean_features: np.ndarray,
    scale_features: np.ndarray,
    reacting: np.ndarray,
) -> Moments:
    """Fit mean and covariance; features are (G, 1 + k), `reacting` (q,) marks the mean coefficients that react."""
    n, rows = data.y.shape[1], len(data.y)
    images = images_of(data, directions)
    J = jacobian(mean_features, reacting)
    location = least_squares(data, J)
    lost = rows / max(rows - location.identified.shape[1], 1)  # degrees of freedom
    residual = location.residual(data) * np.sqrt(lost)
    noise, variance = residual.T @ residual / rows, np.zeros((len(J), len(directions)))
    scale = float(np.trace(noise)) / n
    V = covariances(data, noise, variance, images)
    rounds = 0
    while True:
        whiten = inverse_factors(V, scale)
        location = reweighted(data, location, whiten)
        residual = location.residual(data) * np.sqrt(lost)
        sums = covariance_sums(data, residual, whiten, images)
        totals = sums.by_group(data.group, len(J))
        spread = scale_fit(totals, n, scale_features, variances(totals, n))
        variance = (scale_features @ spread.scales.T) ** 2
        following = covariances(data, spread.noise, variance, images)
        settled = np.linalg.norm(following - V) <= SETTLED * np.linalg.norm(V)
        V, rounds = following, rounds + 1
        if settled or rounds == ROUNDS:
            break
    return Moments(
        location,
        spread,
        _mean_block(data, location, whiten),
        _covariance_block(data, sums, spread, variance),
        variance,
    )


def _mean_block(data: Transitions, location: Location, whiten: np.ndarray) -> Block:
    n = data.y.shape[1]
    sums = mean_sums(data, location.residual(data), whiten)
    maps = np.stack([np.kron(np.eye(n), J @ location.identified) for J in location.jacobian])[data.group]
    free = np.linalg.lstsq(location.identified, location.coefficients.T, rcond=None)[0].T
    return Block(
        free.ravel(),
        np.einsum("upi,up->ui", maps, sums.score),
        np.einsum("upi,upq,uqj->uij", maps, sums.information, maps, optimize=True),
    )


def _covariance_block(data: Transitions, sums: Sums, spread: Spread, variance: np.ndarray) -> Block:
    noise = upper(spread.noise)
    theta = np.concatenate([np.broadcast_to(noise, (len(variance), len(noise))), variance], axis=1)[data.group]
    maps = spread.jacobian[data.group]
    return Block(
        np.concatenate([noise, spread.scales.ravel()]),
        np.einsum("upi,up->ui", maps, sums.score - np.einsum("upq,uq->up", sums.information, theta)),
        np.einsum("upi,upq,uqj->uij", maps, sums.information, maps, optimize=True),
    )
