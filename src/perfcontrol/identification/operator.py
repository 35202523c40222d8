"""Covariances without structure: any covariance of y that is linear in x xᵀ, the same under every policy."""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.location import Location, least_squares, reweighted
from perfcontrol.identification.moments import inverse_factors, monomials, operator_sums, symmetric_basis
from perfcontrol.identification.transitions import Transitions

ROUNDS = 3
LEAST = 0.05  # of the average residual variance: weights take V for no less, where an operator without signs is


class OperatorFit(NamedTuple):
    """theta (s, 1 + s): coefficients of V_ij, i ≤ j, on 1 and x_a x_b, a ≤ b; V (N, n, n) as fitted.

    square (N, n, n): residual products, for the degrees of freedom that the mean took. root: of their average.
    """

    location: Location
    square: np.ndarray
    theta: np.ndarray
    V: np.ndarray
    whiten: np.ndarray
    root: np.ndarray


def operator_fit(data: Transitions, jacobian: np.ndarray) -> OperatorFit:
    """Mean by `jacobian` and covariance in turn, as in `estimate`."""
    n = data.y.shape[1]
    location = least_squares(data, jacobian)
    lost = len(data.y) / max(len(data.y) - location.identified.shape[1], 1)
    residual = location.residual(data)
    average = lost * residual.T @ residual / len(residual)
    scale = float(np.trace(average)) / n
    root = np.linalg.cholesky(average + 1e-12 * max(scale, 1e-300) * np.eye(n))
    design, basis = monomials(data.x), symmetric_basis(n)
    V = np.broadcast_to(average, (len(residual), n, n))
    whiten, theta = inverse_factors(V, scale), np.zeros((len(basis), design.shape[1]))
    square = lost * residual[:, :, None] * residual[:, None, :]
    for _ in range(ROUNDS):
        sums = operator_sums(data, square, whiten, data.x, np.zeros(len(data.group), dtype=int))
        theta = least_solution(sums.information[0], sums.score.sum(axis=0)).reshape(theta.shape)
        V = np.einsum("tq,pq,pij->tij", design, theta, basis, optimize=True)
        whiten = inverse_factors(_lifted(V, root), scale)
        location = reweighted(data, location, whiten)
        residual = location.residual(data)
        square = lost * residual[:, :, None] * residual[:, None, :]
    return OperatorFit(location, square, theta, V, whiten, root)


def _lifted(V: np.ndarray, root: np.ndarray) -> np.ndarray:
    """V with eigenvalues, relative to the average, of at least LEAST."""
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ V @ inverse.T)
    side = root @ vectors * np.sqrt(np.maximum(values, LEAST))[:, None, :]
    return side @ np.swapaxes(side, -1, -2)


def least_solution(information: np.ndarray, score: np.ndarray) -> np.ndarray:
    """The least solution, in columns of unit size, of a semidefinite system that may be singular."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    return scale * (np.linalg.pinv(information * scale * scale[:, None], rcond=1e-10, hermitian=True) @ (scale * score))
