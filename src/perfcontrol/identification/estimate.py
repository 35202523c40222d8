"""Mean and covariance together: weighted least squares for each, with weights from the other, until both rest."""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.blocks import Block, hidden_directions
from perfcontrol.identification.covariance import scale_fit, variances
from perfcontrol.identification.joint import Joint, joint_scoring
from perfcontrol.identification.location import Location, jacobian, least_squares, reweighted
from perfcontrol.identification.moments import (
    FLOOR,
    covariance_sums,
    covariances,
    images_of,
    inverse_factors,
    mean_sums,
    upper,
)
from perfcontrol.identification.transitions import Transitions

ROUNDS = 12
SETTLED = 1e-7
LEAST = 0.25  # of the noise of the round before, in every direction


class Moments(NamedTuple):
    """location: of the mean. noise (n, n) and scales (k, Q): of the covariance V (N, n, n)."""

    location: Location
    noise: np.ndarray
    scales: np.ndarray
    V: np.ndarray

    def whiten(self) -> np.ndarray:
        """L⁻¹, V = L Lᵀ."""
        return inverse_factors(self.V, float(np.trace(self.noise)) / len(self.noise))

    def residual(self, data: Transitions) -> np.ndarray:
        """Residuals, enlarged for the degrees of freedom that the mean took."""
        rows = len(data.y)
        lost = np.sqrt(rows / max(rows - self.location.identified.shape[1], 1))
        return self.location.residual(data) * lost


class Estimated(NamedTuple):
    """Estimates with what every unit contributed: `mean` for the free coefficients of the location, row by row.

    hidden (P, r): what may be added to noise and scales unseen, where the directions are given.
    """

    location: Location
    mean: Block
    spread: Joint
    hidden: np.ndarray


def moments(
    data: Transitions,
    directions: np.ndarray,
    mean_features: np.ndarray,
    scale_features: np.ndarray,
    reacting: np.ndarray,
) -> Moments:
    """Fit mean and covariance; features are (G, 1 + k), `reacting` (q,) marks the mean coefficients that react."""
    n, images = data.y.shape[1], images_of(data, directions)
    location = least_squares(data, jacobian(mean_features, reacting))
    here = Moments(location, np.eye(n), np.zeros((len(directions), scale_features.shape[1])), np.zeros(0))
    residual = here.residual(data)
    noise = residual.T @ residual / len(residual)
    here = here._replace(noise=noise, V=np.broadcast_to(noise, (len(residual), n, n)))
    for _ in range(ROUNDS):
        whiten = here.whiten()
        here = here._replace(location=reweighted(data, here.location, whiten))
        sums = covariance_sums(data, here.residual(data), whiten, images, data.group)
        sums = sums.score_by_group(data.group, len(scale_features))
        noise, scales = scale_fit(sums, n, scale_features, variances(sums, n))
        noise = _damped(noise, here.noise)
        V = covariances(data, noise, (scale_features @ scales.T) ** 2, images)
        moved = np.linalg.norm(V - here.V) / np.linalg.norm(V)
        here = Moments(here.location, noise, scales, V)
        if moved <= SETTLED:
            break
    return here


def _damped(noise: np.ndarray, before: np.ndarray) -> np.ndarray:
    """`noise`, in no direction below a share of what it was: rough squares may say none, and weigh without bounds."""
    root = np.linalg.cholesky(before + FLOOR * max(float(np.trace(before)), np.finfo(float).tiny) * np.eye(len(before)))
    relative = np.linalg.solve(root, np.linalg.solve(root, noise).T)
    values, vectors = np.linalg.eigh((relative + relative.T) / 2)
    side = root @ vectors * np.sqrt(np.maximum(values, LEAST))
    return side @ side.T


def estimated(
    data: Transitions, start: Moments, directions: np.ndarray, scale_features: np.ndarray, free: bool
) -> Estimated:
    """The blocks at `start`; free directions are moved with all else to the best fit first."""
    here, spread = _refined(data, start, directions, scale_features, free)
    for _ in range(2 * free):
        here, spread = _refined(data, here, spread.directions, scale_features, free)
    block = _mean_block(data, here.location, here.whiten())
    return Estimated(here.location, block, spread, _hidden(data, here, spread, scale_features, free))


def _hidden(data: Transitions, here: Moments, spread: Joint, features: np.ndarray, free: bool) -> np.ndarray:
    """See `Estimated`. A scale that was found to be zero is moved: its slope vanishes there, its square is seen."""
    k, width = spread.scales.shape
    s = len(upper(spread.noise))
    if free:
        return np.zeros((s + k * width, 0))
    images = images_of(data, spread.directions)
    information = covariance_sums(data, here.residual(data), here.whiten(), images, data.group).information
    eta = np.abs(features @ spread.scales.T)
    eta = np.maximum(eta, 0.1 * max(float(eta.max(initial=0.0)), 1e-3 * np.sqrt(float(np.trace(spread.noise)))))
    jacobian = np.zeros((len(features), s + k, s + k * width))
    jacobian[:, :s, :s] = np.eye(s)
    for j in range(k):
        jacobian[:, s + j, s + j * width + np.arange(width)] = 2 * eta[:, j, None] * features
    return hidden_directions(np.einsum("gpi,gpq,gqj->ij", jacobian, information, jacobian, optimize=True))


def _refined(
    data: Transitions, here: Moments, directions: np.ndarray, features: np.ndarray, free: bool
) -> tuple[Moments, Joint]:
    """Covariance given the mean, then the mean given the covariance."""
    spread = joint_scoring(data, here.residual(data), features, (here.noise, here.scales, directions), free)
    V = covariances(data, spread.noise, (features @ spread.scales.T) ** 2, images_of(data, spread.directions))
    here = Moments(here.location, spread.noise, spread.scales, V)
    return here._replace(location=reweighted(data, here.location, here.whiten())), spread


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
