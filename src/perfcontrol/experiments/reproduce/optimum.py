"""The cheapest policies of the paper's cases, each with a proof: a search over one number.

The set fixes the row sums; so (`by_stock`) stock l feels row l of the policy alone, and only ‖row l‖² of the deployed
one. With d the deviation of a row's diagonal entry from its mean

    C_T(M; M') = Σ_l c(row l of M; ‖row l of M'‖²),  c = k_0 + k_1 d + k_2 ‖row‖²,

where k_2 > 0 and c does not decrease in its second argument. At given d both squares are least where the other entries
of the row are equal: the optimum is M(d), alike in all rows, and a search over d is a search over all policies. The
row norms of M(d) grow with |d|. On an interval of d the cost is therefore at least the minimum there of the parabola
C_T(M(·); M(d')), d' its point nearest to zero. Intervals are halved where that is too little.
"""

from typing import Any

import numpy as np
import xarray

from perfcontrol.experiments.reproduce.by_stock import row_form
from perfcontrol.experiments.reproduce.cases import Progress, by_case
from perfcontrol.problem import PerformativeProblem

GAP = 1e-3  # relative, between the best policy and the proof
GRID = 24  # points of each round of the search for the best policy, which goes on between the neighbours of the best
WIDTH = 1e-9  # of what is left in the end, relative to the first round
MOST = 5000  # intervals


def symmetric(problem: PerformativeProblem, d: float) -> np.ndarray:
    """M(d): every row of the required sum, its diagonal entry d above the mean, the others alike."""
    stocks, total = _stocks_and_total(problem)
    others = np.full((stocks, stocks), total / stocks - d / (stocks - 1))
    np.fill_diagonal(others, total / stocks + d)
    return others[None]


def _stocks_and_total(problem: PerformativeProblem) -> tuple[int, float]:
    return problem.policy_shape[1], float(problem.feasible_set.row_total)  # type: ignore[arg-type]


def parabola(problem: PerformativeProblem, deployed: Any) -> tuple[Any, Any, Any]:
    """Coefficients of C_T(M(d); M(deployed)) in 1, d and d²; those of each of several deployed."""
    stocks, total = _stocks_and_total(problem)
    even, ratio = total**2 / stocks, stocks / (stocks - 1)  # ‖row‖² of M(d) is even + ratio d²
    constant, by_own, by_square = row_form(problem, total, even + ratio * np.square(deployed))
    return stocks * (constant + by_square * even) + by_own * total, stocks * by_own, stocks * by_square * ratio


def _value(form: tuple[Any, Any, Any], d: Any) -> Any:
    return form[0] + d * (form[1] + d * form[2])


def optimal_policy(problem: PerformativeProblem, gap: float = GAP) -> tuple[float, float, float, int]:
    """The optimal d, its cost, a proved lower bound of what any feasible policy costs, and the intervals used."""

    def cost(d: Any) -> Any:
        return _value(parabola(problem, d), d)

    # Beyond [low, high] even the calmest world is dearer than the policy that spreads everything evenly.
    constant, linear, square = parabola(problem, 0.0)
    low, high = np.sort(np.real(np.roots([square, linear, constant - cost(0.0)])))
    if problem.feasible_set.nonnegative:
        stocks, total = _stocks_and_total(problem)
        low, high = max(low, -total / stocks), min(high, total * (stocks - 1) / stocks)
    ends = low, high
    while ends[1] - ends[0] > WIDTH * (high - low):
        grid = np.linspace(*ends, GRID)
        around = int(np.argmin(cost(grid)))
        ends = grid[max(around - 1, 0)], grid[min(around + 1, GRID - 1)]
    tried = np.array([0.0, *ends])
    costs = cost(tried)
    best, least = float(tried[np.argmin(costs)]), float(np.min(costs))
    lower, cells = lower_bound(problem, (low, high), least * (1 - gap))
    return best, least, min(lower, least), cells


def lower_bound(problem: PerformativeProblem, ends: tuple[float, float], enough: float) -> tuple[float, int]:
    """What no M(d) with d in `ends` costs less than, intervals halved until that is `enough`; how many there were."""
    edges = np.unique([*ends, np.clip(0.0, *ends)])  # no interval has zero inside: the nearest point is an end
    low, high, cells, settled = edges[:-1], edges[1:], len(edges) - 1, np.inf
    while True:
        form = parabola(problem, np.clip(0.0, low, high))
        bounds = _value(form, np.clip(-form[1] / (2 * form[2]), low, high))
        short = bounds < enough
        if not short.any() or cells >= MOST:
            return float(min(settled, bounds.min())), cells
        settled = min(settled, bounds[~short].min(initial=np.inf))
        low, high = low[short], high[short]
        low, high = np.concatenate([low, (low + high) / 2]), np.concatenate([(low + high) / 2, high])
        cells += int(short.sum())


def optimum_stage(problems: list[PerformativeProblem], progress: Progress) -> xarray.Dataset:
    """The optimal policies of all cases, what they cost, and what no policy costs less than."""
    rows: dict[str, list] = {name: [] for name in ("M", "cost", "lower", "cells")}
    for index, problem in enumerate(problems):
        d, cost, lower, cells = optimal_policy(problem)
        for name, value in (("M", symmetric(problem, d)[0]), ("cost", cost), ("lower", lower), ("cells", cells)):
            rows[name].append(value)
        progress("optimal policies", (index + 1) / len(problems))
    return by_case(rows)
