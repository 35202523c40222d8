"""Repeated risk minimisation: deploy, minimise against the world that results, deploy again."""

from typing import Any

import equinox as eqx

from perfcontrol._checks import check_integer
from perfcontrol._linalg import frobenius
from perfcontrol._programs import Numbers, choose, numerics
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import residual_of, respond
from perfcontrol.response.estimate import SampleAverage
from perfcontrol.response.projected import nearest
from perfcontrol.solvers.anderson import Mixing, forget, mix
from perfcontrol.solvers.base import State, start
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.result import Result


class _Own(eqx.Module):
    moved: Numbers  # ‖Φ(M_{n-1}) - M_{n-1}‖
    rate: Numbers  # ratio of the last two
    unique: Numbers
    threshold: Numbers
    mixing: Mixing | None


class RRM(AbstractExactSolver):
    """M_{n+1} = Φ(M_n), exactly; ends when Φ(M) is within `tolerance` of M, relative to ‖M‖.

    With `inner_steps=k` each deployment is followed by k gradient steps Proj(M - g(M; M_n)/‖𝐇‖) instead of the whole
    minimisation (k = 1: repeated gradient descent). The fixed points are the same, and near one an error is multiplied
    by Φ' + (I - 𝐇/‖𝐇‖)ᵏ (I - Φ'): slower where Φ' is small, calmer where Φ' has eigenvalues below -1. With `anderson=m`
    the next policy comes from this and the last m steps (Anderson's acceleration): fewer deployments, and often an end
    where repeated minimisation has none; of convergence nothing is proved.

    For a general convex cost or unknown moments, `solve` takes a key, and Φ from sample averages with common random
    numbers; `.stats` then has `standard_error` (policy_shape), `confidence_radius` (‖M - M^PS‖ is below it with 95 %
    confidence), `samples`, too.

    `.stats`: `rate` (last ratio of the gaps ‖Φ(M) - M‖, of plain steps an estimate of the contraction rate; 0 where
    there was no second one), `residual` (relative natural residual of the last policy deployed: of M where the run
    converged), and without `inner_steps` `unique`.

    Args:
        tolerance: None for 1e-11 in float64, 1e-5 in float32; where responses are sampled, the relative standard
            error of the answer, None for 1e-2.
        max_steps: at most so many deployments.
        sampling: how many paths sampled responses may use; None for `SampleAverage()`.
        inner_steps: gradient steps for each deployment; None to minimise.
        anderson: how many earlier steps Anderson's acceleration uses; 0 for none.

    References:
        Equation (RRM); Lemma on existence and uniqueness of M^PS. Walker and Ni (2011) for Anderson's acceleration;
        docs: "Which method when".
    """

    inner_steps: int | None = eqx.field(static=True)
    anderson: int = eqx.field(static=True)

    def __init__(
        self,
        tolerance: float | None = None,
        max_steps: int = 500,
        sampling: SampleAverage | None = None,
        inner_steps: int | None = None,
        anderson: int = 0,
    ):
        super().__init__(tolerance, max_steps, sampling)
        self.inner_steps = None if inner_steps is None else check_integer("inner_steps", inner_steps, 1)
        self.anderson = check_integer("anderson", anderson, 0)

    def init(self, problem: PerformativeProblem, M0: Any) -> State:
        xp, _ = numerics(M0)
        zero, far = xp.zeros((), M0.dtype), xp.asarray(xp.inf, M0.dtype)
        mixing = forget(M0, self.anderson) if self.anderson else None
        return start(M0, _Own(far, zero, xp.asarray(True), 1e8 * (1 + frobenius(M0)), mixing))

    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        own, tolerance = state.own, self.accuracy(problem, state.M.dtype)
        response = respond(problem, state.M, inner_steps=self.inner_steps)
        following, mixing = response.M, own.mixing
        xp, _ = numerics(following)
        moved, scale = frobenius(following - state.M), frobenius(following)
        done = moved <= tolerance * xp.where(scale > 0, scale, 1)
        if mixing is not None:
            following, mixing = mix(mixing, state.steps, state.M, following)
            following = nearest(problem.feasible_set, following)
            scale = frobenius(following)
        finite = xp.all(xp.isfinite(following))
        diverged = scale > own.threshold
        result = choose(done, Result.success, Result.running)
        result = choose(diverged, Result.diverged, result)
        result = choose(finite, result, Result.nonfinite)
        # The policy that passed is the answer: its residual is known, and its response is itself up to the tolerance.
        moves = finite & ~diverged & ~done
        # Below rounding the ratio of two moves says nothing: keep the last one that did.
        meaningful = xp.isfinite(own.moved) & (moved > 1e3 * xp.finfo(scale.dtype).eps * scale)
        rate = xp.where(meaningful, moved / xp.where(own.moved > 0, own.moved, 1), own.rate)
        kept = _Own(moved, rate, response.unique, own.threshold, mixing)
        return State(choose(moves, following, state.M), state.steps + 1, result, kept)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        unfinished = Result.running if stopped else Result.not_converged
        result = choose(state.result == Result.running, unfinished, state.result)
        stats = {"rate": state.own.rate, "residual": residual_of(problem, state.M, state.M)}
        return result, stats if self.inner_steps is not None else stats | {"unique": state.own.unique}
