"""What stability costs: the naive, the stable and the optimal policy side by side, once the world has reacted.

Three answers to "which policy?": best against the world as it was (naive), best against the world that it makes itself
(stable, where retraining comes to rest), and cheapest of all in the world that it makes (optimal).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from perfcontrol._checks import InputError, check_finite, fail
from perfcontrol.evaluate.exact import exact_cost
from perfcontrol.evaluate.loop import require_moments
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.response import best_response
from perfcontrol.solvers import PerformativeOptimum, Result, Solution, StablePoint, solve
from perfcontrol.solvers.solve import check_feasible
from perfcontrol.theory.optimality.bound import OptimalityBound, bound_from
from perfcontrol.theory.precision import in_double
from perfcontrol.theory.stability.stable_policy import find_stable_policy

SAME = 1e-9  # relative difference up to which two costs are called the same
STATIONARY = 1e-6  # relative residual above which the search for the optimum is said not to have ended


@dataclass(frozen=True)
class PriceOfStability:
    """Three policies and their costs C_T(M; M), each in the world that it makes itself.

    Attributes:
        naive: Φ(deployed_before): the best response in the world before anything reacts.
        stable: M^PS, where retraining from there comes to rest.
        optimal: the cheapest policy known: by descent from several starts, or by the bound. Never dearer than those.
        cost_naive: None where the world that the naive policy makes is not mean-square stable (infinite horizon).
        cost_stable: of M^PS.
        cost_optimal: of `optimal`.
        residual: relative natural residual of the total gradient at `optimal`.
        unique: whether the best response to `stable` is the only one.
        bound: of `pc.optimality_bound`: the interval of the optimal cost, or why none is proved; None with gap=None.
    """

    naive: np.ndarray
    stable: np.ndarray
    optimal: np.ndarray
    cost_naive: float | None
    cost_stable: float
    cost_optimal: float
    residual: float
    unique: bool
    bound: OptimalityBound | None = None

    @property
    def ratio(self) -> float | None:
        """The price of stability, cost_stable / cost_optimal; None where the optimal cost is zero."""
        return _ratio(self.cost_stable, self.cost_optimal)

    @property
    def ratio_bound(self) -> tuple[float, float] | None:
        """The interval of the price of stability that `bound` proves; None where it proves none."""
        lower = None if self.bound is None else self.bound.lower
        if self.ratio is None or lower is None or lower <= 0:
            return None
        return self.ratio, max(self.ratio, self.cost_stable / lower)

    @property
    def ratio_naive(self) -> float | None:
        """cost_naive / cost_optimal: what ignoring the reaction costs."""
        return None if self.cost_naive is None else _ratio(self.cost_naive, self.cost_optimal)

    @property
    def excess_stable(self) -> float:
        """cost_stable - cost_optimal: what foresight saves against retraining."""
        return self.cost_stable - self.cost_optimal

    @property
    def excess_naive(self) -> float | None:
        """cost_naive - cost_optimal: what foresight saves against ignoring the reaction."""
        return None if self.cost_naive is None else self.cost_naive - self.cost_optimal

    def __str__(self) -> str:
        return " ".join([self._stable_against_optimal(), self._naive_against_stable(), self._how_known()])

    def _stable_against_optimal(self) -> str:
        tie = "" if self.unique else " (one of several: best responses to it tie)"
        stable = f"Retraining comes to rest at a stable policy{tie} that costs {self.cost_stable:.6g} in its own world"
        if _same(self.cost_stable, self.cost_optimal):
            return f"{stable}. No cheaper policy is known: foresight would save nothing."
        price = "" if self.ratio is None else f": the price of stability is {in_figures(self.ratio)}"
        return (
            f"{stable}; the best policy found costs {self.cost_optimal:.6g}{price}. Foreseeing the reaction would save "
            f"{self.excess_stable:.4g}, {100 * self.excess_stable / self.cost_stable:.3g} % of the stable cost."
        )

    def _naive_against_stable(self) -> str:
        naive = "The naive policy, best in the world as it was before,"
        if self.cost_naive is None:
            return f"{naive} has no finite cost: it makes a world that is not mean-square stable."
        gap = abs(self.cost_naive - self.cost_stable)
        if _same(self.cost_naive, self.cost_stable):
            return f"{naive} costs the same as the stable one."
        naive = f"{naive} costs {self.cost_naive:.6g}, {gap:.4g}"
        if self.cost_naive < self.cost_stable:
            return f"{naive} less than the stable one: retraining raises the cost."
        return f"{naive} more than the stable one: retraining lowers the cost."

    def _how_known(self) -> str:
        ended = ""
        if self.residual > STATIONARY:
            ended = f" The search for it had not ended: the residual of the total gradient is {self.residual:.1e}."
        if self.bound is None:
            return f"That no policy is cheaper still was not looked into.{ended}"
        if self.bound.lower is None:
            return f"That no policy is cheaper still is not proved: {'; '.join(self.bound.missing)}.{ended}"
        interval = ""
        if self.ratio_bound is not None and not _same(*self.ratio_bound):
            interval = ", so that the price lies between {} and {}".format(*map(in_figures, self.ratio_bound))
        return f"No policy costs less than {self.bound.lower:.6g} ({self.bound.status}){interval}.{ended}"


def in_figures(ratio: float) -> str:
    """A ratio in four figures, or with two of what it has above one."""
    above = ratio - 1
    return f"{ratio:.{4 if above <= 0 or above >= 0.01 else int(2 - np.floor(np.log10(above)))}g}"


def _same(a: float, b: float) -> bool:
    return abs(a - b) <= SAME * max(abs(a), abs(b))


def _ratio(cost: float, optimal: float) -> float | None:
    if cost == optimal:
        return 1.0
    return cost / optimal if optimal > np.finfo(float).eps * cost else None


@in_double
def price_of_stability(
    problem: PerformativeProblem, *, deployed_before: Any = None, starts: int = 8, gap: float | None = 1e-3
) -> PriceOfStability:
    """What it costs that retraining comes to rest where nobody wants to move, and not where it is cheapest.

    The price of stability is C_T(M^PS; M^PS) / C_T(M^PO; M^PO) ≥ 1. Beside both stands the naive policy
    Φ(deployed_before), which ignores that the world reacts to it; it may be cheaper than the stable one. All are found
    in double precision.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        deployed_before: the policy that the world has seen so far, free parameters; None for 0, or the feasible policy
            nearest to it.
        starts: how many policies the search for the optimum descends from.
        gap: relative width at which the proved interval of the optimal cost may stop (see `pc.optimality_bound`); None
            for no proof.

    Returns:
        The policies, their costs, differences and ratios; `str()` of it is a paragraph.

    Raises:
        InputError: as `expected_cost`; `deployed_before` outside the feasible set; no stable policy found.
        OverflowError: a policy costs more than double precision holds.

    References:
        Docs: theory, "The performative optimum".
    """
    require_moments(check_problem(problem))
    solver = PerformativeOptimum(starts=starts)
    before = problem.initial_policy()
    if deployed_before is not None:
        before = problem.check_policy("deployed_before", deployed_before)
        check_feasible("deployed_before", problem, before)
    naive = best_response(problem, before)
    stable = _stable(problem, before)
    optimum = solve(problem, solver, before, throw=False)
    bound = None if gap is None else bound_from(problem, optimum.M, gap)
    cost_stable, cost_naive = _cost(problem, stable.M), _cost(problem, naive)
    if cost_stable is None:
        raise _no_stable_policy("one whose world is not mean-square stable")
    optimal, cost_optimal = stable.M, cost_stable
    others: list[tuple[Any, float | None]] = [(naive, cost_naive), (optimum.M, _cost(problem, optimum.M))]
    if bound is not None and bound.M is not None:
        others.append((bound.M, bound.upper))
    for other, cost in others:
        if cost is not None and cost < cost_optimal:
            optimal, cost_optimal = other, cost
    return PriceOfStability(
        naive=np.asarray(naive),
        stable=np.asarray(stable.M),
        optimal=np.asarray(optimal),
        cost_naive=cost_naive,
        cost_stable=cost_stable,
        cost_optimal=cost_optimal,
        residual=float(optimum.stats["residual"]),
        unique=bool(stable.stats["unique"]),
        bound=bound,
    )


def _stable(problem: PerformativeProblem, start: Any) -> Solution:
    """The stable policy that retraining from `start` leads to, or else one found from other starts."""
    solution = solve(problem, StablePoint(), start, throw=False)
    if solution.result != Result.success:
        solution = find_stable_policy(problem)
    if solution.result != Result.success:
        raise _no_stable_policy("none found")
    return solution


def _no_stable_policy(got: str) -> InputError:
    remedy = "pc.solve(problem, pc.PerformativeOptimum()) gives the optimal policy alone."
    return fail("problem", got, "have a stable policy", remedy)


def _cost(problem: PerformativeProblem, M: Any) -> float | None:
    """C_T(M; M); None where it is infinite."""
    cost = exact_cost(problem, M, M)
    if not problem.is_finite and not np.isfinite(cost):
        return None
    return float(check_finite("the cost", cost))
