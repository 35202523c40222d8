"""Which features of the policy a reaction follows: the choice that predicts best what it has not seen.

A fifth of the units of every deployment is held out in turn. Whole deployments are not: as few as are logged, the
others say nothing of a reaction along the one direction in which this one differs. Predictions are scored by the
quadratic form that the weighted regressions minimise, so that no pass over the data is needed: sums by unit are enough.
More coefficients are preferred only where they gain more than the standard error of the gain over units.
"""

from collections.abc import Callable, Iterator

import numpy as np

from perfcontrol.identification.covariance import scale_fit, variances
from perfcontrol.identification.features import CONSTANT, NORM, SQUARED_NORM, Features, affine
from perfcontrol.identification.location import jacobian
from perfcontrol.identification.moments import Sums, upper
from perfcontrol.identification.operator import least_solution

FOLDS = 5


def candidates(policies: np.ndarray) -> list[Features]:
    """From the simplest on, those that the deployed policies can tell from a constant."""
    found = [CONSTANT]
    for features in (NORM, SQUARED_NORM, affine(policies)):
        values = features.values(policies)
        if np.ptp(values, axis=0).max(initial=0.0) > 1e-9 * np.abs(values).max():
            found.append(features)
    return found


def splits(sums: Sums, group: np.ndarray, count: int) -> Iterator[tuple[np.ndarray, Sums]]:
    """Masks of units to predict, with the sums by deployment of those to fit."""
    fold = np.empty(len(group), dtype=int)
    fold[np.argsort(group, kind="stable")] = np.arange(len(group)) % FOLDS
    total = sums.by_group(group, count)
    for f in range(min(FOLDS, len(group))):
        held = fold == f
        test = Sums(sums.score[held], sums.information[held]).by_group(group[held], count)
        yield held, Sums(total.score - test.score, total.information - test.information)


def _scores(sums: Sums, held: np.ndarray, local: np.ndarray) -> np.ndarray:
    """How well coefficients (U', P) predict the units that were held out, (U',)."""
    through = np.einsum("upq,uq->up", sums.information[held], local)
    return np.einsum("up,up->u", sums.score[held] - through / 2, local)


def best_mean(sums: Sums, group: np.ndarray, policies: np.ndarray, n: int, reacting: np.ndarray) -> Features:
    """For the mean; `sums` of the local coefficients at zero."""
    pairs = list(splits(sums, group, len(policies)))

    def held_out(features: Features) -> np.ndarray:
        maps = np.stack([np.kron(np.eye(n), J) for J in jacobian(features.values(policies), reacting)])
        scores = np.zeros(len(group))
        for held, train in pairs:
            information = np.einsum("gpi,gpq,gqj->ij", maps, train.information, maps, optimize=True)
            score = np.einsum("gpi,gp->i", maps, train.score)
            local = maps @ least_solution(information, score)
            scores[held] = _scores(sums, held, local[group[held]])
        return scores

    return _best(policies, held_out)


def best_scale(sums: Sums, group: np.ndarray, policies: np.ndarray, n: int) -> Features:
    """For the scales of the directions."""
    noise = n * (n + 1) // 2
    pairs = [(held, train, variances(train, n)) for held, train in splits(sums, group, len(policies))]

    def held_out(features: Features) -> np.ndarray:
        values, scores = features.values(policies), np.zeros(len(group))
        for held, train, free in pairs:
            seen = np.einsum("gii->g", train.information) > 0
            part = Sums(train.score[seen], train.information[seen])
            covariance, scales = scale_fit(part, n, values[seen], free[seen])
            common = np.broadcast_to(upper(covariance), (len(values), noise))
            local = np.concatenate([common, (values @ scales.T) ** 2], axis=1)
            scores[held] = _scores(sums, held, local[group[held]])
        return scores

    return _best(policies, held_out)


def _best(policies: np.ndarray, held_out: Callable[[Features], np.ndarray]) -> Features:
    """held_out: features -> score of every unit."""
    best, scores, width = CONSTANT, held_out(CONSTANT), 1
    for features in candidates(policies)[1:]:
        trial, wider = held_out(features), features.values(policies).shape[1]
        gain = trial - scores
        error = np.linalg.norm(gain - gain.mean()) if wider > width else 0.0
        if gain.sum() > error:
            best, scores, width = features, trial, wider
    return best
