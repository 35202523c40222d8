"""The interface of a solver: `init`, `step`, `finish` on a state that every solver carries; what a run returns."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array

from perfcontrol._printing import Printed, Row, of_solution
from perfcontrol._programs import Numbers, known, numerics
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.result import MEMBERS, Result


class SolveError(RuntimeError):
    """A run that did not end well, raised by `solve(throw=True)`.

    Attributes:
        solution: the `Solution`, with what was reached.
    """

    def __init__(self, message: str, solution: "Solution"):
        super().__init__(message)
        self.solution = solution


class State(NamedTuple):
    """What every solver carries: the iterate, the number of steps taken, how the run stands, the solver's own."""

    M: Numbers
    steps: Numbers
    result: Result
    own: Any


class AbstractSolver(eqx.Module):
    """A method with frozen settings."""

    @property
    @abc.abstractmethod
    def max_steps(self) -> int:
        """Steps that `solve` runs at most unless told otherwise."""

    @property
    def needs_key(self) -> bool:
        """Whether steps draw random numbers."""
        return False

    @property
    def draws_along(self) -> bool:
        """Whether all that steps draw are paths for a cost or a gradient, of whose perturbations less is drawn."""
        return False

    @property
    def from_host(self) -> bool:
        """Whether steps do their heavy work in programs of their own, so that the loop need not be compiled."""
        return False

    @property
    def lanes(self) -> int | None:
        """How many runs `solve_many` works on together on a device; None: as many as simulation does well with."""
        return None

    def rescue(self, problem: PerformativeProblem) -> "AbstractSolver | None":
        """The method that `solve` tries from the same start where this one fails; None: the failure is reported."""
        return None

    def on(self, problem: PerformativeProblem, key: Any) -> "AbstractSolver":
        """What `solve` runs for such a problem: this method itself, unless it has another form for it."""
        return self

    @abc.abstractmethod
    def check(self, problem: PerformativeProblem) -> None:
        """Raise InputError where this method does not apply to the problem."""

    @abc.abstractmethod
    def init(self, problem: PerformativeProblem, M0: Any) -> State:
        """The state before the first step."""

    @abc.abstractmethod
    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        """One iteration; `key` is that iteration's own."""

    def opening(self, problem: PerformativeProblem, state: State, count: int) -> tuple[State, Any] | None:
        """The first steps, `count` at most, by one program, and the policies after each; None: one after the other."""
        return None

    @abc.abstractmethod
    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        """Result and statistics of the last state; `stopped` says that max_steps of `solve` cut the run short."""


class Solution(Printed, eqx.Module):
    """What `solve` returns.

    Attributes:
        M: the policy (free parameters), finite always.
        result: a `Result`.
        steps: iterations taken; where the run failed, the iteration at which it did.
        history: `record` at steps 0, every, 2·every, ... (leading axis), the last value repeated once a run has ended.
        stats: method-specific numbers, such as `unique` and `residual`.
    """

    M: Array
    result: Result
    steps: Array
    history: Any
    stats: dict[str, Array]

    def described(self) -> tuple[str, list[Row]]:
        return of_solution(self, self._ended())

    def summary(self) -> str:
        """What was found, how accurately, after how many steps; of a batch how many runs ended in which way."""
        return str(self)

    def __str__(self) -> str:
        return super().__str__() if known(self.M, self.steps, self.stats) else repr(self)

    def _ended(self) -> str:
        if not self.steps.ndim:
            return Result[self.result]
        counts = [(int(np.sum(np.asarray(self.result == member))), Result[member]) for member in MEMBERS.values()]
        return "; ".join(f"{count} of {self.steps.size}: {text}" for count, text in counts if count)


def start(M0: Any, own: Any = None) -> State:
    """The first state."""
    xp, _ = numerics(M0)
    return State(M0, xp.zeros((), int), Result.running, own)
