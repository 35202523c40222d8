"""Five allocations of one market: two that need no model of the reaction, and naive, stable and optimal ones."""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import nnls

from perfcontrol.evaluate import expected_cost
from perfcontrol.perturbations import StockPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import best_response
from perfcontrol.solvers import PerformativeOptimum, Result, StablePoint, solve
from perfcontrol.theory.stability.local_model import local_model, spectral_radius

ALLOCATIONS: tuple[str, ...] = ("equal weight", "minimum variance", "naive", "stable", "optimal")
TOLERANCE = 1e-8  # relative residual; weights are read to a few digits


class Allocations(NamedTuple):
    """Policies of one market by name (nan where none was found), and what is known of them.

    policies: (1, L, L) each. costs: C_T(M; M), each in the world that it makes itself. residual: of the total gradient
    at the optimal policy. rate: spectral radius of the best response's derivative at the stable policy; retraining
    converges to it from nearby if it is below 1.
    """

    policies: dict[str, np.ndarray]
    costs: dict[str, float]
    residual: float
    rate: float


def allocations(problem: PerformativeProblem, starts: int = 1, near: Any = None) -> Allocations:
    """All five; the search for the optimal one begins at `near` as well, where a policy is given."""
    law: Any = problem.perturbation
    exposure, (_, count, _) = float(law.exposure), problem.policy_shape
    equal = np.full(problem.policy_shape, exposure / count)
    calm = minimum_variance(np.asarray(law.growth.covariance), problem.feasible_set.nonnegative)
    least = np.broadcast_to(exposure * calm, problem.policy_shape)
    naive = np.asarray(best_response(problem, equal))
    stable = solve(problem, StablePoint(TOLERANCE), equal, throw=False)
    solver = PerformativeOptimum(starts=starts, tolerance=TOLERANCE)
    optimum = solve(problem, solver, least if near is None else near, throw=False)
    at_rest, rate = np.full(problem.policy_shape, np.nan), np.nan
    if stable.result == Result.success:
        at_rest = np.asarray(stable.M)
        rate = spectral_radius(local_model(problem, at_rest).response_jacobian)
    policies: dict[str, np.ndarray] = dict(
        zip(ALLOCATIONS, (equal, least, naive, at_rest, np.asarray(optimum.M)), strict=True)
    )
    costs = {name: own_cost(problem, M) for name, M in policies.items()}
    return Allocations(policies, costs, float(optimum.stats["residual"]), rate)


def own_cost(problem: PerformativeProblem, M: np.ndarray) -> float:
    """C_T(M; M); nan where there is no policy, infinite where the cost overflows."""
    if not np.all(np.isfinite(M)):
        return np.nan
    try:
        return float(expected_cost(problem, M))
    except OverflowError:
        return np.inf


def minimum_variance(covariance: np.ndarray, long_only: bool) -> np.ndarray:
    """Weights of sum one, (L,), that minimise wᵀ covariance w; nonnegative ones if `long_only`."""
    scaled = covariance / np.trace(covariance)
    if long_only:
        # min ‖F w‖² + (1ᵀw - 1)² over w ≥ 0 has the direction of the answer, whatever its length
        values, vectors = np.linalg.eigh(scaled)
        root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
        ones = np.ones((1, len(scaled)))
        weights, _ = nnls(np.vstack([root, ones]), np.append(np.zeros(len(scaled)), 1.0))
    else:
        weights = np.linalg.solve(scaled, np.ones(len(scaled)))
    return weights / weights.sum()


def weights(problem: PerformativeProblem, M: np.ndarray) -> np.ndarray:
    """The portfolio (L, L) behind a policy: its row l says what is bought with account l."""
    law: Any = problem.perturbation
    assert isinstance(law, StockPerturbation)
    return np.asarray(M)[0] / float(law.exposure)
