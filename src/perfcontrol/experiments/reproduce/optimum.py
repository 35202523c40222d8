"""The cheapest policies of the paper's cases, each with a proof: a search over one number.

Stocks are alike and independent, and the set fixes the row sums. So E Δ_t does not depend on the policy; stock l feels
row l of it alone, and only ‖row l‖² of the deployed one. With d the deviation of a row's diagonal entry from its mean

    C_T(M; M') = Σ_l c(row l of M; ‖row l of M'‖²),  c = k_0 + k_1 d + k_2 ‖row‖²,

where k_2 ≥ 0 and c does not decrease in its second argument. At given d both squares are least where the other entries
of the row are equal: the optimum is M(d), alike in all rows, and a search over d is a search over all policies. The
row norms of M(d) grow with |d|. On an interval of d the cost is therefore at least the minimum there of the parabola
C_T(M(·); M(d')), d' its point nearest to zero. Intervals are halved, that of the lowest bound first.
"""

import heapq
import itertools

import numpy as np
import xarray

from perfcontrol.evaluate.cost_to_go import world_of
from perfcontrol.evaluate.exact import weigh
from perfcontrol.experiments.reproduce.cases import Progress, by_case
from perfcontrol.problem import PerformativeProblem

GAP = 1e-3  # relative, between the best policy and the proof
GRID = 24  # points that the search for the best policy starts from
MOST = 5000  # intervals


def symmetric(problem: PerformativeProblem, d: float) -> np.ndarray:
    """M(d): every row of the required sum, its diagonal entry d above the mean, the others alike."""
    _, stocks, _ = problem.policy_shape
    total = float(problem.feasible_set.row_total)  # type: ignore[arg-type]
    others = np.full((stocks, stocks), total / stocks - d / (stocks - 1))
    np.fill_diagonal(others, total / stocks + d)
    return others[None]


def parabola(problem: PerformativeProblem, deployed: float) -> np.poly1d:
    """C_T(M(d); M(deployed)) in d, by three evaluations."""
    world = world_of(problem, symmetric(problem, deployed))
    points = np.array([-1.0, 0.0, 1.0])
    values = [float(weigh(problem, world, symmetric(problem, d))[0]) for d in points]
    return np.poly1d(np.polyfit(points, values, 2))


def optimal_policy(problem: PerformativeProblem, gap: float = GAP) -> tuple[float, float, float, int]:
    """The optimal d, its cost, a proved lower bound of what any feasible policy costs, and the intervals used."""
    from scipy.optimize import minimize_scalar

    def cost(d: float) -> float:
        return float(weigh(problem, world_of(problem, symmetric(problem, d)), symmetric(problem, d))[0])

    # Beyond [low, high] even the calmest world is dearer than the policy that spreads everything evenly.
    calmest, even = parabola(problem, 0.0), cost(0.0)
    low, high = np.sort(np.real((calmest - even).roots))
    if problem.feasible_set.nonnegative:
        total, stocks = float(problem.feasible_set.row_total), problem.policy_shape[1]  # type: ignore[arg-type]
        low, high = max(low, -total / stocks), min(high, total * (stocks - 1) / stocks)
    grid = np.linspace(low, high, GRID)
    around = int(np.argmin([cost(d) for d in grid]))
    ends = grid[max(around - 1, 0)], grid[min(around + 1, GRID - 1)]
    found = minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": 1e-10})
    best = min((0.0, *ends, float(found.x)), key=cost)
    lower, cells = lower_bound(problem, (low, high), cost(best) * (1 - gap))
    return best, cost(best), min(lower, cost(best)), cells


def lower_bound(problem: PerformativeProblem, ends: tuple[float, float], enough: float) -> tuple[float, int]:
    """What no M(d) with d in `ends` costs less than, intervals halved until that is `enough`; how many there were."""

    def bounded(low: float, high: float) -> tuple[float, float, float]:
        form = parabola(problem, float(np.clip(0.0, low, high)))
        lowest = np.clip(-form[1] / (2 * form[2]), low, high) if form[2] > 0 else low
        return min(form(low), form(high), form(lowest)), low, high

    low, high = ends
    cuts = [low, 0.0, high] if low < 0 < high else [low, high]
    waiting = [bounded(*pair) for pair in itertools.pairwise(cuts)]
    cells = len(waiting)
    heapq.heapify(waiting)
    while waiting[0][0] < enough and cells < MOST:
        _, low, high = heapq.heappop(waiting)
        for pair in ((low, (low + high) / 2), ((low + high) / 2, high)):
            heapq.heappush(waiting, bounded(*pair))
        cells += 1
    return waiting[0][0], cells


def optimum_stage(problems: list[PerformativeProblem], progress: Progress) -> xarray.Dataset:
    """The optimal policies of all cases, what they cost, and what no policy costs less than."""
    rows: dict[str, list] = {name: [] for name in ("M", "cost", "lower", "cells")}
    for index, problem in enumerate(problems):
        d, cost, lower, cells = optimal_policy(problem)
        for name, value in (("M", symmetric(problem, d)[0]), ("cost", cost), ("lower", lower), ("cells", cells)):
            rows[name].append(value)
        progress("optimal policies", (index + 1) / len(problems))
    return by_case(rows)
