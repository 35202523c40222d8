"""What the solvers that do not sample have in common: a tolerance, a limit on steps, moments that they need."""

import equinox as eqx

from perfcontrol._checks import check_integer, check_positive_tolerance, check_tolerance
from perfcontrol.evaluate.loop import require_moments
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.base import AbstractSolver


class AbstractExactSolver(AbstractSolver):
    """A method that works with exact best responses until a relative tolerance is reached.

    tolerance: None for 1e-11 in float64, 1e-5 in float32. limit: at most so many steps.
    """

    tolerance: float | None = eqx.field(static=True)
    limit: int = eqx.field(static=True)

    def __init__(self, tolerance: float | None, max_steps: int):
        self.tolerance = check_positive_tolerance(tolerance)
        self.limit = check_integer("max_steps", max_steps, 1)

    @property
    def max_steps(self) -> int:
        return self.limit

    @property
    def from_host(self) -> bool:
        return True

    def check(self, problem: PerformativeProblem) -> None:
        require_moments(problem)
        check_tolerance(self.tolerance, problem.dtype)
