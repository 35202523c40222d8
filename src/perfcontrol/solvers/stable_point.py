"""The performatively stable policy itself: a fixed point of the best response, exactly and fast.

Repeated minimisation while it contracts well; else Newton steps on F(M) = Φ(M) - M, whose linear systems
(I - Φ'(M)) δ = F are solved by GMRES with products Φ'(M) δ, so that fixed points are found where repeated
minimisation runs away from them.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._linalg import frobenius, solve
from perfcontrol._programs import Numbers, choose, cond, numerics, program, while_loop
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import Response, residual_of, respond, response_jacobian, response_pushforward
from perfcontrol.response.estimate import SampleAverage
from perfcontrol.response.projected import nearest
from perfcontrol.solvers.base import AbstractSolver, State, start
from perfcontrol.solvers.continuation import Continuation
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.result import Result

CONTRACTING = 0.1  # repeated minimisation goes on while each step shrinks the gap at least tenfold
HALVINGS = 6
KRYLOV = 30
DENSE = 64  # free parameters up to which Φ' is a matrix, not products
CONTINUED = 256  # free parameters up to which a stable policy is also looked for by continuation
FAR = 1e8  # growth of ‖M‖ over 1 + ‖M_0‖ + ‖Φ(M_0)‖ beyond which a Newton step is refused: see `step`


class _Own(eqx.Module):
    response: Numbers  # Φ(M)
    gap: Numbers  # ‖Φ(M) - M‖
    ratio: Numbers  # of the last two gaps
    unique: Numbers
    limit: Numbers  # of ‖M‖
    contracting: Numbers  # whether every step so far was one of minimisation that shrank the gap well


class StablePoint(AbstractExactSolver):
    """The fixed point M^PS = Φ(M^PS), to a relative natural residual of `tolerance`.

    Exact for a quadratic cost and known moments; else given a key, by sample averages (see `RRM`). Finds stable points
    at which repeated minimisation diverges. Where Newton's method starts too far off and the set is bounded, `solve`
    goes on with `pc.Continuation` from the same start (with known numbers only: not under jit or vmap).

    `.stats`: `residual` (relative natural residual), `unique` (of the best response, at M^PS), `rate` (last ratio of
    gaps), `rescued` (whether continuation found the answer; `steps` counts its steps, too, `history` does not).

    Args:
        tolerance: None for 1e-11 in float64, 1e-5 in float32; where responses are sampled, the relative standard
            error of the answer, None for 1e-2.
        max_steps: at most so many steps.
        rescue: whether to go on with continuation.
        sampling: how many paths sampled responses may use; None for `SampleAverage()`.
    """

    rescues: bool = eqx.field(static=True)

    def __init__(
        self,
        tolerance: float | None = None,
        max_steps: int = 60,
        rescue: bool = True,
        sampling: SampleAverage | None = None,
    ):
        super().__init__(tolerance, max_steps, sampling)
        self.rescues = rescue

    def rescue(self, problem: PerformativeProblem) -> AbstractSolver | None:
        bounded = problem.feasible_set.radius(problem.policy_shape) is not None
        held = math.prod(problem.policy_shape) <= CONTINUED
        return Continuation(self.tolerance, sampling=self.sampling) if self.rescues and bounded and held else None

    def init(self, problem: PerformativeProblem, M0: Any) -> State:
        # The first step moves nowhere and evaluates M0.
        xp, _ = numerics(M0)
        far, yes = xp.asarray(xp.inf, M0.dtype), xp.asarray(True)
        return start(M0, _Own(M0, far, xp.zeros((), M0.dtype), yes, far, yes))

    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        own = state.own
        contracting = own.contracting
        F = own.response - state.M
        direction = cond(contracting, lambda: F, lambda: _newton_direction(problem, state.M, own.response))
        xp, _ = numerics(problem, state)

        # Repeated minimisation takes its step as it is; Newton halves its own until the gap shrinks. Where Φ' has the
        # eigenvalue 1 up to rounding, Newton points to infinity, where every relative gap is small: not that far.
        def helps(M: Any, gap: Any) -> Any:
            return (gap < own.gap) & (frobenius(M) <= own.limit)

        def try_length(carry: Any) -> Any:
            length, count, *_ = carry
            M = nearest(problem.feasible_set, state.M + length * direction)
            response = respond(problem, M)
            return length / 2, count + 1, M, response, frobenius(response.M - M)

        def unaccepted(carry: Any) -> Any:
            _, count, M, _, gap = carry
            return (count == 0) | (~contracting & ~helps(M, gap) & (count < HALVINGS))

        first = (xp.ones((), F.dtype), xp.asarray(0), state.M, Response(own.response, own.unique), own.gap)
        _, _, M, response, gap = while_loop(unaccepted, try_length, first)
        finite = xp.isfinite(gap) & xp.all(xp.isfinite(M))
        ratio = gap / xp.where(own.gap > 0, own.gap, 1)  # zero at the first step: a step of minimisation follows
        limit = xp.where(state.steps == 0, FAR * (1 + frobenius(M) + frobenius(response.M)), own.limit)
        tolerance = self.accuracy(problem)
        scale = frobenius(M)
        done = gap <= 0.1 * tolerance * xp.where(scale > 0, scale, 1)
        # A Newton step that no longer helps has reached rounding, or is stuck: `finish` tells which by the residual.
        stalled = ~contracting & ~helps(M, gap)
        # A step of minimisation that widens the gap is taken back, and Newton goes on from where it started.
        widened = contracting & (state.steps > 0) & ~(gap < own.gap) & ~done
        result = choose(done | stalled, Result.success, Result.running)
        result = choose(finite | widened, result, Result.nonfinite)
        good = finite & ~stalled & ~widened
        # Newton once, Newton to the end: a step of minimisation would expand what a good Newton step has shrunk.
        still = contracting & (ratio <= CONTRACTING)
        kept = choose(good, _Own(response.M, gap, ratio, response.unique, limit, still), own)
        kept = eqx.tree_at(lambda k: k.contracting, kept, kept.contracting & ~widened)
        return State(choose(good, M, state.M), state.steps + 1, result, kept)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        residual = residual_of(problem, state.M, state.M)
        unfinished = Result.running if stopped else Result.not_converged
        failed = choose(state.result == Result.nonfinite, Result.nonfinite, unfinished)
        result = choose(residual <= self.accuracy(problem), Result.success, failed)
        return result, {
            "residual": residual,
            "unique": state.own.unique,
            "rate": state.own.ratio,
            "rescued": numerics(state.M)[0].asarray(False),
        }


def _newton_direction(problem: PerformativeProblem, M: Any, response: Any) -> Any:
    """δ with (I - Φ'(M)) δ = Φ(M) - M; half a step of repeated minimisation where that fails."""
    xp, _ = numerics(problem, M, response)
    F = response - M
    if M.size > DENSE:
        direction = _by_products(problem, M, response)
    else:
        system = xp.eye(M.size, dtype=M.dtype) - response_jacobian(problem, M, response)
        direction = solve(system, F.reshape(-1)).reshape(M.shape)
    return xp.where(xp.all(xp.isfinite(direction)), direction, F / 2)


@program
def _by_products(problem: PerformativeProblem, M: Any, response: Any) -> Array:
    """The direction by GMRES, with products Φ'(M) V alone."""
    pushforward = response_pushforward(problem, M, response)
    direction, _ = jax.scipy.sparse.linalg.gmres(
        lambda V: V - pushforward(V),
        response - M,
        tol=1e-10,
        restart=min(KRYLOV, M.size),
        maxiter=4,
        solve_method="incremental",  # which ends as soon as the tolerance is met
    )
    return jnp.asarray(direction)
