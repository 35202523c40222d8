"""Repeated risk minimisation: deploy, minimise against the world that results, deploy again."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import check_tolerance
from perfcontrol._linalg import frobenius
from perfcontrol.evaluate.best_response import respond
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.loop import State, start
from perfcontrol.solvers.result import Result


class _Own(eqx.Module):
    moved: Array  # ‖M_n - M_{n-1}‖
    rate: Array  # ratio of the last two moves
    unique: Array
    residual: Array  # relative natural residual of the last policy deployed
    threshold: Array


class RRM(AbstractExactSolver):
    """M_{n+1} = Φ(M_n), exactly; ends when a step moves less than `tolerance` relative to ‖M‖.

    `.stats`: `rate` (last ratio of moves, an estimate of the contraction rate; 0 where there was no second move),
    `residual` (relative natural residual of the last policy deployed: of M where the run converged), `unique`.

    Args:
        tolerance: None for 1e-11 in float64, 1e-5 in float32.
        max_steps: at most so many minimisations.

    References:
        Equation (RRM); Lemma on existence and uniqueness of M^PS.
    """

    def __init__(self, tolerance: float | None = None, max_steps: int = 500):
        super().__init__(tolerance, max_steps)

    def init(self, problem: PerformativeProblem, M0: Array) -> State:
        infinite = jnp.asarray(jnp.inf, M0.dtype)
        threshold = 1e8 * (1 + frobenius(M0))
        own = _Own(infinite, jnp.zeros((), M0.dtype), jnp.asarray(True), infinite, threshold)
        return start(M0, own)

    def step(self, problem: PerformativeProblem, state: State, key: Array | None) -> State:
        tolerance = check_tolerance(self.tolerance, problem.dtype)
        response = respond(problem, state.M)
        following = response.M
        moved = frobenius(following - state.M)
        scale = frobenius(following)
        finite = jnp.all(jnp.isfinite(following))
        diverged = scale > state.own.threshold
        done = moved <= tolerance * jnp.where(scale > 0, scale, 1)
        result = Result.where(done, Result.success, Result.running)
        result = Result.where(diverged, Result.diverged, result)
        result = Result.where(finite, result, Result.nonfinite)
        # The policy that passed is the answer: its residual is known, and its response is itself up to the tolerance.
        moves = finite & ~diverged & ~done
        # Below rounding the ratio of two moves says nothing: keep the last one that did.
        meaningful = moved > 1e3 * jnp.finfo(scale.dtype).eps * scale
        rate = jnp.where(jnp.isfinite(state.own.moved) & meaningful, moved / state.own.moved, state.own.rate)
        own = _Own(moved, rate, response.unique, response.residual, state.own.threshold)
        return State(jnp.where(moves, following, state.M), state.steps + 1, result, own)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Array]]:
        unfinished = Result.running if stopped else Result.not_converged
        result = Result.where(state.result == Result.running, unfinished, state.result)
        stats = {
            "rate": state.own.rate,
            "unique": state.own.unique,
            "residual": state.own.residual,
        }
        return result, stats
