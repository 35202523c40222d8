"""What the solvers that work with best responses have in common: a tolerance, a limit on steps, exact or sampled."""

from typing import Any

import equinox as eqx

from perfcontrol._checks import check_integer, check_key, check_positive_tolerance, check_tolerance
from perfcontrol.evaluate.loop import require_moments
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response.estimate import TOLERANCE, SampleAverage, as_sampling, is_exact
from perfcontrol.response.sampled import Sampled, Uncertainty, uncertainty
from perfcontrol.solvers.base import AbstractSolver
from perfcontrol.solvers.sampled_run import SampledRun

SHARE = 1e-2  # of the standard error that is allowed: how exactly the fixed point of a sample is solved for


class AbstractExactSolver(AbstractSolver):
    """A method that works with best responses until a relative tolerance is reached.

    Given a key, it samples the best responses that cannot be had exactly (`SampledRun`).

    tolerance: None for 1e-11 in float64, 1e-5 in float32, and for 1e-2 where responses are sampled. limit: at most so
    many steps. sampling: how many paths sampled responses may use; None for `SampleAverage()`.
    """

    tolerance: float | None = eqx.field(static=True)
    limit: int = eqx.field(static=True)
    sampling: SampleAverage

    def __init__(self, tolerance: float | None, max_steps: int, sampling: SampleAverage | None = None):
        self.tolerance = check_positive_tolerance(tolerance)
        self.limit = check_integer("max_steps", max_steps, 1)
        self.sampling = as_sampling(sampling)

    @property
    def max_steps(self) -> int:
        return self.limit

    @property
    def from_host(self) -> bool:
        return True

    def on(self, problem: PerformativeProblem, key: Any) -> AbstractSolver:
        if key is None or is_exact(problem):
            return self
        return SampledRun(self, check_key(key), self.tolerance, self.sampling)

    def sampled(self, problem: PerformativeProblem, key: Any, samples: Any, M: Any) -> Sampled:
        """The world of sample averages that the method works in, when it sets out from M."""
        return Sampled(problem, key, samples)

    def uncertainty(self, world: Any, M: Any) -> Uncertainty:
        """Of the answer M in such a world."""
        return uncertainty(world, M)

    def check(self, problem: PerformativeProblem) -> None:
        require_moments(problem)
        check_tolerance(self.tolerance, problem.dtype)

    def accuracy(self, problem: PerformativeProblem, dtype: Any) -> float:
        """The tolerance to which the fixed point is solved for: of a sampled one well below its standard error."""
        least = check_tolerance(None if isinstance(problem, Sampled) else self.tolerance, dtype)
        if not isinstance(problem, Sampled):
            return least
        return max(SHARE * (TOLERANCE if self.tolerance is None else self.tolerance), 10 * least)
