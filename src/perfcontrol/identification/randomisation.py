"""Do deployments share their coefficients? A randomisation test for many coefficients at once, under unequal laws.

Q_j = Σ_g S_gj² / c_gj with S_gj = Σ_u a_ugj a sum of independent contributions, of mean zero if nothing reacts, and
c_gj their summed squares about the mean of each deployment. The laws of the contributions differ, since states and
inputs follow the policy: labels must not be permuted. Instead every episode, as it stands about the mean of its
deployment, changes sign at random, all its contributions together, and Q is computed anew, c included. This keeps all
covariances.
As episodes grow in number the law under flips tends to that under the null (the central limit theorem, deployment by
deployment); no finite number makes it exact.
"""

import numpy as np

from perfcontrol.identification.deviations import centred

CHUNK = 2**22  # numbers held at a time


def quadratic_statistics(contributions: np.ndarray, group: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Q of contributions (U, G, J), observed and under the rows of `signs` (P, U): (P+1, J), the observed first."""
    units, groups, count = contributions.shape
    flat = contributions.reshape(units, -1)
    members = [np.flatnonzero(group == h) for h in np.unique(group)]
    residual = centred(contributions, group)
    square = np.sum(residual**2, axis=0)
    negligible = square <= 1e-20 * np.sum(flat**2, axis=0).max(initial=0.0)  # rounding
    observed = _ratio(flat.sum(axis=0) ** 2, square, negligible)
    out = np.empty((len(signs) + 1, count))
    out[0] = observed.reshape(groups, count).sum(axis=0)
    step = max(1, CHUNK // max(flat.shape[1], 1))
    for first in range(0, len(signs), step):
        part = signs[first : first + step]
        total = np.zeros((len(part), flat.shape[1]))
        variance = np.zeros_like(total)
        for rows in members:
            own = part[:, rows] @ residual[rows]
            total += own
            about_mean = np.sum(residual[rows] ** 2, axis=0) - own**2 / len(rows)
            variance += about_mean * len(rows) / max(len(rows) - 1, 1)
        flipped = _ratio(total**2, variance, negligible)
        out[1 + first : 1 + first + len(part)] = flipped.reshape(-1, groups, count).sum(axis=1)
    return out


def _ratio(square: np.ndarray, variance: np.ndarray, negligible: np.ndarray) -> np.ndarray:
    return np.where(negligible, 0.0, square / np.where(negligible, 1.0, np.maximum(variance, 1e-300)))


def p_values(statistics: np.ndarray) -> np.ndarray:
    """p of every row of (P+1, K) among all rows, column by column: the share of rows that are at least as large."""
    order = np.sort(statistics, axis=0)
    below = np.stack([np.searchsorted(o, s, side="left") for o, s in zip(order.T, statistics.T, strict=True)], axis=1)
    return (len(statistics) - below) / len(statistics)


def combined(statistics: np.ndarray) -> float:
    """One p-value from several statistics (P+1, K), the first row observed: that of the smallest of their p-values."""
    least = p_values(statistics).min(axis=1)
    return float(np.mean(least <= least[0]))
