"""Repeated risk minimisation: deploy, minimise against the world that results, deploy again."""

from typing import Any

import equinox as eqx

from perfcontrol._linalg import frobenius
from perfcontrol._programs import Numbers, choose, numerics
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import residual_of, respond
from perfcontrol.response.estimate import SampleAverage
from perfcontrol.solvers.base import State, start
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.result import Result


class _Own(eqx.Module):
    moved: Numbers  # ‖M_n - M_{n-1}‖
    rate: Numbers  # ratio of the last two moves
    unique: Numbers
    threshold: Numbers


class RRM(AbstractExactSolver):
    """M_{n+1} = Φ(M_n), exactly; ends when a step moves less than `tolerance` relative to ‖M‖.

    For a general convex cost or unknown moments, `solve` takes a key, and Φ from sample averages with common random
    numbers; `.stats` then has `standard_error` (policy_shape), `confidence_radius` (‖M - M^PS‖ is below it with 95 %
    confidence), `samples`, too.

    `.stats`: `rate` (last ratio of moves, an estimate of the contraction rate; 0 where there was no second move),
    `residual` (relative natural residual of the last policy deployed: of M where the run converged), `unique`.

    Args:
        tolerance: None for 1e-11 in float64, 1e-5 in float32; where responses are sampled, the relative standard
            error of the answer, None for 1e-2.
        max_steps: at most so many minimisations.
        sampling: how many paths sampled responses may use; None for `SampleAverage()`.

    References:
        Equation (RRM); Lemma on existence and uniqueness of M^PS.
    """

    def __init__(self, tolerance: float | None = None, max_steps: int = 500, sampling: SampleAverage | None = None):
        super().__init__(tolerance, max_steps, sampling)

    def init(self, problem: PerformativeProblem, M0: Any) -> State:
        xp, _ = numerics(M0)
        zero, far = xp.zeros((), M0.dtype), xp.asarray(xp.inf, M0.dtype)
        return start(M0, _Own(far, zero, xp.asarray(True), 1e8 * (1 + frobenius(M0))))

    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        own, tolerance = state.own, self.accuracy(problem)
        response = respond(problem, state.M)
        following = response.M
        xp, _ = numerics(following)
        moved, scale = frobenius(following - state.M), frobenius(following)
        finite = xp.all(xp.isfinite(following))
        diverged = scale > own.threshold
        done = moved <= tolerance * xp.where(scale > 0, scale, 1)
        result = choose(done, Result.success, Result.running)
        result = choose(diverged, Result.diverged, result)
        result = choose(finite, result, Result.nonfinite)
        # The policy that passed is the answer: its residual is known, and its response is itself up to the tolerance.
        moves = finite & ~diverged & ~done
        # Below rounding the ratio of two moves says nothing: keep the last one that did.
        meaningful = xp.isfinite(own.moved) & (moved > 1e3 * xp.finfo(scale.dtype).eps * scale)
        rate = xp.where(meaningful, moved / xp.where(own.moved > 0, own.moved, 1), own.rate)
        kept = _Own(moved, rate, response.unique, own.threshold)
        return State(choose(moves, following, state.M), state.steps + 1, result, kept)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        unfinished = Result.running if stopped else Result.not_converged
        result = choose(state.result == Result.running, unfinished, state.result)
        residual = residual_of(problem, state.M, state.M)
        return result, {"rate": state.own.rate, "unique": state.own.unique, "residual": residual}
