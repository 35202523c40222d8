"""Which features of the policy a reaction follows: the choice that predicts best what it has not seen.

From three deployments on, each is left out in turn and predicted from the others; with two, a fifth of the episodes of
each. Predictions are scored by the quadratic form that the weighted regressions minimise, so that no pass over the data
is needed: sums by deployment are enough.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from perfcontrol.identification.covariance import scale_fit, variances
from perfcontrol.identification.features import CONSTANT, NORM, SQUARED_NORM, Features, affine
from perfcontrol.identification.location import jacobian
from perfcontrol.identification.moments import Sums, upper
from perfcontrol.identification.operator import least_solution

FOLDS = 5
MARGIN = 2.0  # log-likelihood that a reaction must gain on unseen data before it is preferred to none


def candidates(policies: np.ndarray) -> list[Features]:
    """From the simplest on, those that the deployed policies can tell from a constant."""
    found = [CONSTANT]
    for features in (NORM, SQUARED_NORM, affine(policies)):
        values = features.values(policies)
        if np.ptp(values, axis=0).max(initial=0.0) > 1e-9 * np.abs(values).max():
            found.append(features)
    return found


def splits(sums: Sums, group: np.ndarray, count: int) -> Iterator[tuple[Sums, Sums]]:
    """Pairs of sums by deployment: what to fit, what to predict."""
    total = sums.by_group(group, count)
    if count >= 3:
        held = [group == g for g in range(count)]
    else:
        rank = np.concatenate([np.arange(np.sum(group == g)) for g in np.unique(group)])  # units sorted by deployment
        order = np.argsort(group, kind="stable")
        fold = np.empty(len(group), dtype=int)
        fold[order] = rank % FOLDS
        held = [fold == f for f in range(FOLDS)]
    for mask in held:
        test = Sums(sums.score[mask], sums.information[mask]).by_group(group[mask], count)
        yield Sums(total.score - test.score, total.information - test.information), test


def _score(test: Sums, local: np.ndarray) -> float:
    return float(np.sum(test.score * local) - np.einsum("gi,gij,gj->", local, test.information, local) / 2)


def best_mean(sums: Sums, group: np.ndarray, policies: np.ndarray, n: int, reacting: np.ndarray) -> Features:
    """For the mean; `sums` of the local coefficients at zero."""
    pairs = list(splits(sums, group, len(policies)))

    def held_out(features: Features) -> float:
        maps = np.stack([np.kron(np.eye(n), J) for J in jacobian(features.values(policies), reacting)])
        total = 0.0
        for train, test in pairs:
            information = np.einsum("gpi,gpq,gqj->ij", maps, train.information, maps, optimize=True)
            score = np.einsum("gpi,gp->i", maps, train.score)
            total += _score(test, maps @ least_solution(information, score))
        return total

    return _best(policies, held_out)


def best_scale(sums: Sums, group: np.ndarray, policies: np.ndarray, n: int) -> Features:
    """For the scales of the directions."""
    noise = n * (n + 1) // 2
    pairs = [(train, test, variances(train, n)) for train, test in splits(sums, group, len(policies))]

    def held_out(features: Features) -> float:
        values, total = features.values(policies), 0.0
        for train, test, free in pairs:
            seen = np.einsum("gii->g", train.information) > 0
            part = Sums(train.score[seen], train.information[seen])
            covariance, scales = scale_fit(part, n, values[seen], free[seen])
            common = np.broadcast_to(upper(covariance), (len(values), noise))
            total += _score(test, np.concatenate([common, (values @ scales.T) ** 2], axis=1))
        return total

    return _best(policies, held_out)


def _best(policies: np.ndarray, held_out: Any) -> Features:
    best, highest = CONSTANT, -np.inf
    for features in candidates(policies):
        score = held_out(features) - (MARGIN if features is not CONSTANT else 0.0)
        if score > highest + 1e-6 * abs(highest) or highest == -np.inf:
            best, highest = features, score
    return best
