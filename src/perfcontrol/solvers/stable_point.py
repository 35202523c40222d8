"""The performatively stable policy itself: a fixed point of the best response, exactly and fast.

Repeated minimisation while it contracts well; else Newton steps on F(M) = Φ(M) - M, whose linear systems
(I - Φ'(M)) δ = F are solved by GMRES with products Φ'(M) δ, so that fixed points are found where repeated
minimisation runs away from them.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import check_tolerance
from perfcontrol._linalg import frobenius
from perfcontrol.evaluate.best_response import Response, respond, response_pushforward
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.loop import State, start
from perfcontrol.solvers.result import Result

CONTRACTING = 0.1  # repeated minimisation goes on while each step shrinks the gap at least tenfold
HALVINGS = 6
KRYLOV = 30
FAR = 1e8  # growth of ‖M‖ over 1 + ‖M_0‖ + ‖Φ(M_0)‖ beyond which a Newton step is refused: see `step`


class _Own(eqx.Module):
    response: Array  # Φ(M)
    gap: Array  # ‖Φ(M) - M‖
    ratio: Array  # of the last two gaps
    unique: Array
    residual: Array  # relative natural residual of M
    limit: Array  # of ‖M‖
    contracting: Array  # whether every step so far was one of minimisation that shrank the gap well


class StablePoint(AbstractExactSolver):
    """The fixed point M^PS = Φ(M^PS), to a relative natural residual of `tolerance`.

    Needs a quadratic cost and known moments; no sampling. Finds stable points at which repeated minimisation
    diverges. `.stats`: `residual` (relative natural residual), `unique` (of the best response, at M^PS),
    `rate` (last ratio of gaps).

    Args:
        tolerance: None for 1e-11 in float64, 1e-5 in float32.
        max_steps: at most so many steps.
    """

    def __init__(self, tolerance: float | None = None, max_steps: int = 60):
        super().__init__(tolerance, max_steps)

    def init(self, problem: PerformativeProblem, M0: Array) -> State:
        # The first step moves nowhere and evaluates M0: one place that compiles the best response.
        far = jnp.asarray(jnp.inf, M0.dtype)
        return start(M0, _Own(M0, far, jnp.zeros((), M0.dtype), jnp.asarray(True), far, far, jnp.asarray(True)))

    def step(self, problem: PerformativeProblem, state: State, key: Array | None) -> State:
        own = state.own
        contracting = own.contracting
        F = own.response - state.M
        direction = jax.lax.cond(contracting, lambda: F, lambda: _newton_direction(problem, state.M, own.response))

        # Repeated minimisation takes its step as it is; Newton halves its own until the gap shrinks. Where Φ' has the
        # eigenvalue 1 up to rounding, Newton points to infinity, where every relative gap is small: not that far.
        def helps(M: Array, gap: Array) -> Array:
            return (gap < own.gap) & (frobenius(M) <= own.limit)

        def try_length(carry: Any) -> Any:
            length, count, *_ = carry
            M = problem.feasible_set.project(state.M + length * direction)
            response = respond(problem, M)
            return length / 2, count + 1, M, response, frobenius(response.M - M)

        def unaccepted(carry: Any) -> Array:
            _, count, M, _, gap = carry
            return (count == 0) | (~contracting & ~helps(M, gap) & (count < HALVINGS))

        one = jnp.ones((), F.dtype)
        known = Response(own.response, own.unique, own.residual)
        _, _, M, response, gap = jax.lax.while_loop(
            unaccepted, try_length, (one, jnp.asarray(0), state.M, known, own.gap)
        )
        finite = jnp.isfinite(gap) & jnp.all(jnp.isfinite(M))
        ratio = gap / jnp.where(own.gap > 0, own.gap, 1)  # zero at the first step: a step of minimisation follows
        limit = jnp.where(state.steps == 0, FAR * (1 + frobenius(M) + frobenius(response.M)), own.limit)
        tolerance = check_tolerance(self.tolerance, problem.dtype)
        scale = frobenius(M)
        done = gap <= 0.1 * tolerance * jnp.where(scale > 0, scale, 1)
        # A Newton step that no longer helps has reached rounding, or is stuck: `finish` tells which by the residual.
        stalled = ~contracting & ~helps(M, gap)
        # A step of minimisation that widens the gap is taken back, and Newton goes on from where it started.
        widened = contracting & (state.steps > 0) & ~(gap < own.gap) & ~done
        result = Result.where(done | stalled, Result.success, Result.running)
        result = Result.where(finite | widened, result, Result.nonfinite)
        good = finite & ~stalled & ~widened
        # Newton once, Newton to the end: a step of minimisation would expand what a good Newton step has shrunk.
        still = contracting & (ratio <= CONTRACTING)
        following = _Own(response.M, gap, ratio, response.unique, response.residual, limit, still)
        kept = jax.tree.map(lambda new, old: jnp.where(good, new, old), following, own)
        kept = eqx.tree_at(lambda k: k.contracting, kept, kept.contracting & ~widened)
        return State(jnp.where(good, M, state.M), state.steps + 1, result, kept)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Array]]:
        tolerance = check_tolerance(self.tolerance, problem.dtype)
        unfinished = Result.running if stopped else Result.not_converged
        result = Result.where(
            state.own.residual <= tolerance,
            Result.success,
            Result.where(state.result == Result.nonfinite, Result.nonfinite, unfinished),
        )
        return result, {"residual": state.own.residual, "unique": state.own.unique, "rate": state.own.ratio}


def _newton_direction(problem: PerformativeProblem, M: Array, response: Array) -> Array:
    """δ with (I - Φ'(M)) δ = Φ(M) - M, by GMRES; half a step of repeated minimisation where that fails."""
    pushforward = response_pushforward(problem, M, response)
    F = response - M
    direction, _ = jax.scipy.sparse.linalg.gmres(
        lambda V: V - pushforward(V), F, tol=1e-10, restart=min(KRYLOV, M.size), maxiter=4
    )
    return jnp.where(jnp.all(jnp.isfinite(direction)), direction, F / 2)
