"""Which policy: the solver loop and the methods, one a file."""

from perfcontrol.solvers.averaging import Average
from perfcontrol.solvers.base import AbstractSolver, Solution, SolveError
from perfcontrol.solvers.confidence import ConfidenceRegion, confidence_region
from perfcontrol.solvers.continuation import Continuation
from perfcontrol.solvers.estimated_dynamics import EstimatedDynamics
from perfcontrol.solvers.gradients import AbstractGradient, Exact, Pathwise
from perfcontrol.solvers.many import solve_many
from perfcontrol.solvers.optimum import PerformativeOptimum
from perfcontrol.solvers.result import Result
from perfcontrol.solvers.rrm import RRM
from perfcontrol.solvers.rsgd import RSGD
from perfcontrol.solvers.schedules import Greedy, Lazy
from perfcontrol.solvers.solve import solve
from perfcontrol.solvers.stable_point import StablePoint
from perfcontrol.solvers.step_sizes import InverseStep, PowerStep
from perfcontrol.solvers.two_point import TwoPoint

__all__ = [
    "RRM",
    "RSGD",
    "AbstractGradient",
    "AbstractSolver",
    "Average",
    "ConfidenceRegion",
    "Continuation",
    "EstimatedDynamics",
    "Exact",
    "Greedy",
    "InverseStep",
    "Lazy",
    "Pathwise",
    "PerformativeOptimum",
    "PowerStep",
    "Result",
    "Solution",
    "SolveError",
    "StablePoint",
    "TwoPoint",
    "confidence_region",
    "solve",
    "solve_many",
]
