"""Mean dynamics by weighted least squares: what of F, B and the noise mean is common, and what follows the policy.

Local coefficients β_g (n, q) on ρ = [x, v, 1]; β_g = Σ_j f_gj γ_j, where the columns of γ_j, j ≥ 1, that do not react
are zero. What the logs cannot tell apart is found once, in standardised columns, and left at zero.
"""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.moments import mean_sums
from perfcontrol.identification.transitions import Transitions

COLLINEAR = 1e-6  # singular values of standardised regressors below this share of the largest count as zero


class Location(NamedTuple):
    """coefficients (n, p). jacobian (G, q, p): β_g = coefficients jacobian_gᵀ.

    identified (p, p'): coefficients = free identifiedᵀ. unidentified (p, p - p'): what may be added to them unseen.
    """

    coefficients: np.ndarray
    jacobian: np.ndarray
    identified: np.ndarray
    unidentified: np.ndarray

    def local(self) -> np.ndarray:
        """β_g, (G, n, q)."""
        return self.coefficients @ np.swapaxes(self.jacobian, -1, -2)

    def residual(self, data: Transitions) -> np.ndarray:
        """y - β_g ρ, (N, n)."""
        beta, out = self.local(), np.empty_like(data.y)
        regressors, group = data.regressors, data.row_group
        for g in range(len(beta)):
            rows = group == g
            out[rows] = data.y[rows] - regressors[rows] @ beta[g].T
        return out


def jacobian(features: np.ndarray, reacting: np.ndarray) -> np.ndarray:
    """(G, q, q + r·features) for features (G, 1 + k) and the mask (q,) of reacting columns."""
    q = len(reacting)
    reacting_columns = np.eye(q)[:, reacting]
    blocks = [np.broadcast_to(np.eye(q), (len(features), q, q))]
    blocks += [column[:, None, None] * reacting_columns for column in features[:, 1:].T]
    return np.concatenate(blocks, axis=2)


def identified_bases(data: Transitions, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bases of the coefficients (p) that the regressors can tell apart, and of those that they cannot."""
    gram = np.einsum("gqi,gqr,grj->ij", jacobian, _grams(data, len(jacobian)), jacobian)
    scale = np.sqrt(np.diag(gram))
    scale[scale <= _negligible(data, jacobian)] = np.inf  # a column of rounding errors is no column
    values, vectors = np.linalg.eigh(gram / scale / scale[:, None])
    kept = values > COLLINEAR**2 * values.max(initial=0.0)
    unseen = vectors[:, ~kept] / np.where(np.isinf(scale), 1, scale)[:, None]
    return vectors[:, kept] / scale[:, None], unseen


def _grams(data: Transitions, count: int) -> np.ndarray:
    regressors, group = data.regressors, data.row_group
    return np.stack([regressors[group == g].T @ regressors[group == g] for g in range(count)])


def _negligible(data: Transitions, jacobian: np.ndarray) -> np.ndarray:
    """Norms below which a column is rounding: relative to all states for x, to the inputs for v."""
    u = data.v - data.x @ data.gain.T
    size = np.concatenate(
        [
            np.full(data.x.shape[1], np.linalg.norm(data.x)),
            np.full(data.v.shape[1], np.linalg.norm(u) + np.linalg.norm(data.v - u)),
            [np.sqrt(len(data.x))],
        ]
    )
    return COLLINEAR * np.sqrt(np.einsum("gqi,q->i", jacobian**2, size**2) / len(jacobian))


def least_squares(data: Transitions, jacobian: np.ndarray) -> Location:
    """Without weights: where the iteration starts."""
    blank = Location(np.zeros((data.y.shape[1], jacobian.shape[2])), jacobian, *identified_bases(data, jacobian))
    flat = np.broadcast_to(np.eye(data.y.shape[1]), (len(data.x), *2 * data.y.shape[1:]))
    return reweighted(data, reweighted(data, blank, flat), flat)  # twice: the second solves for what rounding left


def reweighted(data: Transitions, location: Location, whiten: np.ndarray) -> Location:
    """Weighted least squares with weights whitenᵀ whiten."""
    n = data.y.shape[1]
    sums = mean_sums(data, location.residual(data), whiten, data.group)
    sums = sums.score_by_group(data.group, len(location.jacobian))
    maps = np.stack([np.kron(np.eye(n), J @ location.identified) for J in location.jacobian])
    information = np.einsum("gpi,gpq,gqj->ij", maps, sums.information, maps, optimize=True)
    score = np.einsum("gpi,gp->i", maps, sums.score)
    step = np.linalg.solve(information, score).reshape(n, -1)
    return location._replace(coefficients=location.coefficients + step @ location.identified.T)
