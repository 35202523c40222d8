"""A proved interval for the optimal cost: how good the performative optimum can be at best.

C_T(M; M) = 𝒞(M, θ(M)) with θ = σ², and 𝒞 is convex in M and increases in every θ_{tk}. On a cell of the few scalars
that θ depends on, 𝒞(M, θ⁻) at the cell's least variances bounds it from below, and its minimum is a convex problem.

References: docs: theory, "The performative optimum", Theorem 10.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np

from perfcontrol._checks import check_integer, fail
from perfcontrol.evaluate import expected_cost
from perfcontrol.perturbations import DirectionalPerturbation, NoPerturbation, StockPerturbation
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.solvers.optimum import PerformativeOptimum
from perfcontrol.solvers.solve import solve
from perfcontrol.theory.assumptions import Assumption, Status, weakest, word_of
from perfcontrol.theory.certificates.ingredients import FIXED_NOISE
from perfcontrol.theory.certificates.quadratic_form import expansion
from perfcontrol.theory.derivatives import obstacles
from perfcontrol.theory.existence import constant_mean
from perfcontrol.theory.optimality.recognise import scalars_of
from perfcontrol.theory.optimality.relaxation import relaxation_of
from perfcontrol.theory.optimality.search import Search, Share
from perfcontrol.theory.optimality.stock_rows import obstacles_to_rows, row_shares
from perfcontrol.theory.precision import in_double

LEAST_GAP = 1e-9  # rounding of costs and of minimisers leaves no smaller one provable


@dataclass(frozen=True)
class OptimalityBound:
    """lower ≤ min over the feasible set of C_T(M; M) ≤ upper, a proof up to rounding in double precision.

    Attributes:
        applicable: whether the problem has the form that the proof needs.
        missing: what to change where it has not; numbers are None then.
        lower: no policy costs less.
        upper: the cost of `M`.
        M: the cheapest policy known, policy_shape.
        gap: (upper - lower)/|upper|.
        closed: whether that is as small as was asked for.
        cells: how many cells were bounded.
        assumptions: what the proof rests on.
    """

    applicable: bool
    missing: tuple[str, ...] = ()
    lower: float | None = None
    upper: float | None = None
    M: np.ndarray | None = None
    gap: float | None = None
    closed: bool = False
    cells: int = 0
    assumptions: tuple[Assumption, ...] = ()

    @property
    def status(self) -> Status:
        """How the interval is known: "proved", or "declared" where it rests on the user's word."""
        return weakest(self.assumptions)

    def __str__(self) -> str:
        if not self.applicable:
            return "The optimal cost is not bounded from below: " + "; ".join(self.missing) + "."
        return (
            f"The optimal cost lies between {self.lower:.6g} and {self.upper:.6g} ({self.status}): no policy is "
            f"cheaper than the best one found by more than {100 * (self.gap or 0):.2g} %. Cells bounded: {self.cells}."
        )


def optimality_bound(problem: PerformativeProblem, gap: float = 1e-3, max_cells: int = 2000) -> OptimalityBound:
    """Bound the optimal cost min C_T(M; M) from below and above, by branch and bound to global optimality.

    For quadratic costs and perturbations along fixed directions whose mean does not react along the feasible set, with
    scales that are constant, `Affine` of rank up to three, a `Norm`, or a `Function(f, convex=True)` of values (k,).
    And for `StockPerturbation` on sets that fix the row sums, where stocks grow independently and alike and nothing
    else couples them.

    Args:
        problem: a finite horizon.
        gap: relative width (upper - lower)/|upper| at which to stop.
        max_cells: at most so many cells; what is proved by then is returned.

    Returns:
        An `OptimalityBound`.

    Raises:
        InputError: a gap below what rounding allows, or no cells.

    References:
        docs: theory, "The performative optimum", Theorem 10.
    """
    return bound_from(problem, None, gap, max_cells)


@in_double
def bound_from(problem: PerformativeProblem, known: Any, gap: float, max_cells: int = 2000) -> OptimalityBound:
    """`optimality_bound` with a good policy that is known already; None to look for one."""
    if not isinstance(gap, int | float | np.number) or not LEAST_GAP <= gap < np.inf:
        raise fail("gap", repr(gap), f"be a number, at least {LEAST_GAP:g}", "Pass gap=1e-3 for a tenth of a per cent.")
    max_cells = check_integer("max_cells", max_cells, 1)
    check_problem(problem)
    missing = _missing(problem)
    if missing:
        return OptimalityBound(False, tuple(missing))
    shares = _shares(problem)
    if isinstance(shares, str):
        return OptimalityBound(False, (shares,))
    known = solve(problem, PerformativeOptimum(), throw=False).M if known is None else known
    best = np.asarray(known, dtype=float).reshape(-1)
    searches = [Search(share, best) for share in shares]

    def ends() -> tuple[float, float]:
        return sum(s.times * s.lower for s in searches), sum(s.times * s.upper for s in searches)

    while sum(search.cells for search in searches) < max_cells:
        lower, upper = ends()
        if upper - lower <= gap * abs(upper):
            break
        max(searches, key=lambda search: search.times * search.gap).refine()
    lower, upper = ends()
    width = (upper - lower) / abs(upper) if upper else 0.0
    cells = sum(search.cells for search in searches)
    M = np.zeros_like(best)
    for search in searches:
        M[search.share.places] = search.M
    M = M.reshape(problem.policy_shape)
    return OptimalityBound(True, (), lower, upper, M, width, width <= gap, cells, _assumptions(problem))


def _missing(problem: PerformativeProblem) -> list[str]:
    if not problem.is_finite:
        return ["the horizon is infinite: bound problem.truncated(200), or another finite horizon"]
    missing = obstacles(problem)
    law = problem.perturbation
    if isinstance(law, StockPerturbation):
        missing += obstacles_to_rows(problem)
    elif not isinstance(law, DirectionalPerturbation | NoPerturbation):
        wanted = "perturbation=pc.DirectionalPerturbation(directions, pc.Norm(offset, weight))"
        missing.append(f"the perturbations are not of fixed directions: pass {wanted}")
    if not missing and not constant_mean(problem):
        remedy = "pass mean=None, or for stocks a set that fixes the row sums, such as pc.RowSum(exposure)"
        missing.append(f"the mean of the perturbations depends on the policy: {remedy}")
    if problem.noise_reacts:
        missing.append(FIXED_NOISE)
    return missing


def _shares(problem: PerformativeProblem) -> list[Share] | str:
    if isinstance(problem.perturbation, StockPerturbation):
        return row_shares(problem)
    if isinstance(problem.perturbation, NoPerturbation):
        still = DirectionalPerturbation(np.eye(problem.state_size)[None], np.zeros(1))
        problem = eqx.tree_at(lambda p: p.perturbation, problem, still)
    scalars = scalars_of(problem)
    if isinstance(scalars, str):
        return scalars
    shape = problem.policy_shape

    def value(M: np.ndarray) -> float:
        return float(expected_cost(problem, M.reshape(shape)))

    def improve(M: np.ndarray) -> np.ndarray:
        found = np.asarray(solve(problem, PerformativeOptimum(), M.reshape(shape), throw=False).M, dtype=float)
        return found.reshape(-1) if value(found) < value(M) else M

    everywhere = np.arange(np.prod(shape))[None]
    form, relax = (lambda variances: expansion(problem, variances)), relaxation_of(problem)
    return [Share(everywhere, scalars, form, relax, value, improve)]


def _assumptions(problem: PerformativeProblem) -> tuple[Assumption, ...]:
    declared = getattr(getattr(problem.perturbation, "scale", None), "declared_convex", None)
    word = (
        Assumption("the sublevel sets of the scales are convex", "declared"),
        Assumption("the least sizes of the scales are those that descent found", "estimated"),
    )
    word = word if declared else ()
    return (Assumption("the lower bound of every cell", "proved"), *word, *word_of(problem))
