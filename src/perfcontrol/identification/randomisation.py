"""Do deployments share their coefficients? A randomisation test for many coefficients at once, under unequal laws.

T_gj = S_gj² / c_gj with S_gj = Σ_u a_ugj a sum of independent contributions, of mean zero if nothing reacts, and c_gj
their summed squares about the mean of each deployment. The laws of the contributions differ, since states and inputs
follow the policy: labels must not be permuted. Instead every episode, as it stands about the mean of its deployment,
changes sign at random, all its contributions together, and T is computed anew, c included. This keeps all covariances.
The largest T shows a change of one coefficient in one deployment, their sum one that is spread over many.
As episodes grow in number the law under flips tends to that under the null (the central limit theorem, deployment by
deployment); no finite number makes it exact.
"""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.deviations import centred

CHUNK = 2**22  # numbers held at a time


class Statistics(NamedTuple):
    """For each coefficient j the largest T_gj over deployments g and the sum: observed, then under flips, (P+1, J)."""

    largest: np.ndarray
    total: np.ndarray


def statistics_of(contributions: np.ndarray, group: np.ndarray, signs: np.ndarray) -> Statistics:
    """Of contributions (U, G, J), observed and under the rows of `signs` (P, U)."""
    units, groups, count = contributions.shape
    flat = contributions.reshape(units, -1)
    members = [np.flatnonzero(group == h) for h in np.unique(group)]
    residual = centred(contributions, group)
    square = np.sum(residual**2, axis=0)
    negligible = square <= 1e-20 * np.sum(flat**2, axis=0).max(initial=0.0)  # rounding
    found = [_ratio(flat.sum(axis=0, keepdims=True) ** 2, square, negligible)]
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
        found.append(_ratio(total**2, variance, negligible))
    by_deployment = [ratio.reshape(-1, groups, count) for ratio in found]
    return Statistics(*(np.concatenate([reduced(T, axis=1) for T in by_deployment]) for reduced in (np.max, np.sum)))


def _ratio(square: np.ndarray, variance: np.ndarray, negligible: np.ndarray) -> np.ndarray:
    return np.where(negligible, 0.0, square / np.where(negligible, 1.0, np.maximum(variance, 1e-300)))


def p_values(statistics: np.ndarray) -> np.ndarray:
    """p of every row of (P+1, K) among all rows, column by column: the share of rows that are at least as large."""
    order = np.sort(statistics, axis=0)
    below = np.stack([np.searchsorted(o, s, side="left") for o, s in zip(order.T, statistics.T, strict=True)], axis=1)
    return (len(statistics) - below) / len(statistics)


def least_of(statistics: np.ndarray) -> np.ndarray:
    """One statistic from several (P+1, K), (P+1,): the smallest of their p-values, its sign turned."""
    return -p_values(statistics).min(axis=1)


def combined(statistics: np.ndarray) -> float:
    """One p-value from several statistics (P+1, K), the first row observed: that of the smallest of their p-values."""
    least = least_of(statistics)
    return float(np.mean(least >= least[0]))
