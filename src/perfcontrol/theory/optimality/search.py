"""Branch and bound over the scalars that the variances depend on: the cell with the lowest bound is cut in two."""

import heapq
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from perfcontrol.theory.certificates.quadratic_form import Expansion
from perfcontrol.theory.optimality.relaxation import Relaxation
from perfcontrol.theory.optimality.scalars import AbstractScalars


class Share(NamedTuple):
    """A part of the cost with scalars and parameters of its own; shares, each as often as it occurs, add up to it."""

    places: np.ndarray  # (times, p): where its parameters stand in the policy, flattened, for each time it occurs
    scalars: AbstractScalars
    form: Callable[[np.ndarray], Expansion]  # variances (T, k) -> the cost as a convex quadratic
    relax: Callable[[Expansion], Relaxation]
    value: Callable[[np.ndarray], float]  # M (p,) -> C(M; M)
    improve: Callable[[np.ndarray], np.ndarray]  # a policy -> one no dearer


class Search:
    """lower ≤ min C(M; M) ≤ upper = C(M; M) at M, for one share; every `refine` raises the first or lowers the last."""

    def __init__(self, share: Share, policy: np.ndarray):
        self.share, self.times = share, len(share.places)
        self.upper, _, self.M = min(
            (share.value(policy[place]), i, policy[place]) for i, place in enumerate(share.places)
        )
        self.cells, self._count = 0, itertools.count()
        self._heap: list[tuple[float, int, np.ndarray, np.ndarray]] = []
        self._unit = np.maximum(np.abs(share.scalars.at(self.M)), 1e-3)
        self._add(-np.inf, share.scalars.low, share.scalars.high)

    @property
    def lower(self) -> float:
        return min(self._heap[0][0], self.upper) if self._heap else self.upper

    @property
    def gap(self) -> float:
        return self.upper - self.lower

    def refine(self) -> None:
        """Cut the cell with the lowest bound in two."""
        bound, _, low, high = heapq.heappop(self._heap)
        for part in self._halves(low, high):
            self._add(bound, *part)

    def _add(self, known: float, low: np.ndarray, high: np.ndarray) -> None:
        share = self.share
        self.cells += 1
        form = share.form(share.scalars.variances(low, high))
        found = share.scalars.least(share.relax(form), low, high, self.upper)
        bound = max(known, found.value)
        if bound >= self.upper:  # no policy in here is cheaper than one already known
            return
        value = share.value(found.M)
        if value < self.upper:
            better = share.improve(found.M) if value < self.upper - 1e-6 * abs(self.upper) else found.M
            self.M, self.upper = better, share.value(better)
        heapq.heappush(self._heap, (bound, next(self._count), low, high))

    def _halves(self, low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        if not len(low):
            return
        open_sides = ~(np.isfinite(low) & np.isfinite(high))
        where = int(np.argmax(open_sides) if open_sides.any() else np.argmax(self.share.scalars.spread(low, high)))
        middle = self._middle(low[where], high[where], where)
        left, right = high.copy(), low.copy()
        left[where] = right[where] = middle
        yield low, left
        yield right, high

    def _middle(self, low: float, high: float, where: int) -> float:
        """The midpoint; cells without an end are cut where the best policy is, and then ever farther out."""
        if np.isfinite(low) and np.isfinite(high):
            return (low + high) / 2
        here = float(self.share.scalars.at(self.M)[where])
        if np.isfinite(low):
            return here + 2 * max(low - here, self._unit[where])
        if np.isfinite(high):
            return here - 2 * max(here - high, self._unit[where])
        return here
