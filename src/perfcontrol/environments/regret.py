"""What the deployed policy costs exactly, and how much more than the stable and the optimal one."""

import functools
from typing import Any

import numpy as np

from perfcontrol._checks import fail
from perfcontrol.evaluate import expected_cost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import AbstractSolver, PerformativeOptimum, Result, StablePoint, solve
from perfcontrol.theory.derivatives import obstacles


class Oracle:
    """Exact costs of deployed policies; the two policies of reference are found when first asked for."""

    def __init__(self, problem: PerformativeProblem):
        missing = obstacles(problem)
        if missing:
            got = f"a problem of which too little is known ({'; '.join(missing)})"
            raise fail("regret", got, "be False where exact costs are not known", "Pass regret=False.")
        self.problem = problem

    @functools.cached_property
    def references(self) -> dict[str, float]:
        """The costs of the stable and of the optimal policy, without those that were not found."""
        return {name: cost for name, solver in SOLVERS.items() if (cost := self._cost_of(solver)) is not None}

    def _cost_of(self, solver: AbstractSolver) -> float | None:
        solution = solve(self.problem, solver, throw=False)
        return float(expected_cost(self.problem, solution.M)) if solution.result == Result.success else None

    def info(self, deployed: Any) -> dict[str, Any]:
        """`cost`, `regret_to_stable` and `regret_to_optimal` of policies (N, *policy_shape), each (N,)."""
        different, places = np.unique(np.asarray(deployed), axis=0, return_inverse=True)
        costs = np.array([float(expected_cost(self.problem, M)) for M in different])[places.reshape(-1)]
        return {"cost": costs, **{f"regret_to_{name}": costs - cost for name, cost in self.references.items()}}


SOLVERS = {"stable": StablePoint(), "optimal": PerformativeOptimum()}
