"""The performatively stable policy itself: a fixed point of the best response, exactly and fast.

Repeated minimisation with a secant correction while it contracts well, for plain problems in one program (`opening`);
else Newton steps on F(M) = Φ(M) - M, whose linear systems
(I - Φ'(M)) δ = F are solved by GMRES with products Φ'(M) δ, so that fixed points are found where repeated
minimisation runs away from them.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._linalg import frobenius, solve
from perfcontrol._programs import Numbers, choose, cond, numerics, program, while_loop
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import Response, residual_of, respond, response_jacobian, response_pushforward
from perfcontrol.response.estimate import SampleAverage
from perfcontrol.response.projected import nearest
from perfcontrol.response.sampled import Sampled
from perfcontrol.solvers.base import AbstractSolver, State, start
from perfcontrol.solvers.continuation import Continuation
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.opening import opened, secant_direction
from perfcontrol.solvers.result import Result, ended

CONTRACTING = 0.1  # repeated minimisation goes on while each step shrinks the gap at least tenfold
HALVINGS = 6
ROUNDINGS = 20
KRYLOV = 30
DENSE = 64  # free parameters up to which Φ' is a matrix, not products
CONTINUED = 256  # free parameters up to which a stable policy is also looked for by continuation
FAR = 1e8  # growth of ‖M‖ over 1 + ‖M_0‖ + ‖Φ(M_0)‖ beyond which a Newton step is refused: see `step`


class _Own(NamedTuple):
    response: Response  # to M
    gap: Numbers  # ‖Φ(M) - M‖
    ratio: Numbers  # of the last two gaps
    before: Numbers  # M and Φ(M) one step ago, (2, *policy_shape)
    limit: Numbers  # of ‖M‖
    contracting: Numbers  # whether every step so far was one of minimisation that shrank the gap well


class StablePoint(AbstractExactSolver):
    """The fixed point M^PS = Φ(M^PS), to a relative natural residual of `tolerance`.

    Repeated minimisation, corrected by what its last step showed, while it contracts well; then Newton's method, which
    finds stable points at which repeated minimisation diverges. Where it starts too far off and the set is bounded,
    `solve` goes on with `pc.Continuation` from the same start (with known numbers only: not under jit or vmap).
    Exact for a quadratic cost and known moments; else given a key, by sample averages (see `RRM`).

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
        unknown = Response(M0, yes, None if isinstance(problem, Sampled) else far)
        return start(M0, _Own(unknown, far, xp.zeros((), M0.dtype), xp.stack([M0, M0]), far, yes))

    def opening(self, problem: PerformativeProblem, state: State, count: int) -> tuple[State, Any] | None:
        found = opened(problem, state.M, CONTRACTING, self._enough(problem, state.M.dtype), count)
        if found is None:
            return None
        policies, images, gaps, response = found
        if len(policies) > 1:  # all steps but the last have gone well: there is nothing to judge
            before = response._replace(M=images[-2])  # of which only M counts
            own = state.own._replace(response=before, gap=gaps[-2], limit=_limit(policies[0], images[0]))
            state = State(policies[-2], state.steps + len(policies) - 1, state.result, own)
        state = self._judged(problem, state, policies[-1], response, gaps[-1])
        taken = np.array_equal(state.M, policies[-1])  # a step taken back falls to the method at large
        return (state, list(policies)) if taken else None

    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        M, own = state.M, state.own
        contracting = own.contracting
        F = own.response.M - M
        xp, _ = numerics(F)
        direction = cond(
            contracting,
            lambda: secant_direction(M, own.response.M, *own.before),
            lambda: _newton_direction(problem, M, own.response.M),
        )

        # Repeated minimisation takes its step as it is; Newton halves its own until the gap shrinks.
        def try_length(carry: Any) -> Any:
            length, count, *_ = carry
            following = nearest(problem.feasible_set, M + length * direction)
            response = respond(problem, following)
            return length / 2, count + 1, following, response, frobenius(response.M - following)

        def unaccepted(carry: Any) -> Any:
            _, count, following, _, gap = carry
            return (count == 0) | (~contracting & ~_helps(own, following, gap) & (count < HALVINGS))

        first = (xp.ones((), F.dtype), xp.asarray(0), M, own.response, own.gap)
        _, _, following, response, gap = while_loop(unaccepted, try_length, first)
        return self._judged(problem, state, following, response, gap)

    def _judged(
        self, problem: PerformativeProblem, state: State, following: Any, response: Response, gap: Any
    ) -> State:
        """The state after a step to `following`, or back where it was."""
        M, own = state.M, state.own
        contracting = own.contracting
        xp, _ = numerics(gap, own)
        finite = xp.isfinite(gap) & xp.all(xp.isfinite(following))
        ratio = gap / xp.where(own.gap > 0, own.gap, 1)  # zero at the first step: a step of minimisation follows
        scale = frobenius(following)
        limit = xp.where(state.steps == 0, _limit(following, response.M), own.limit)
        done = gap <= self._enough(problem, M.dtype) * xp.where(scale > 0, scale, 1)
        # A Newton step that no longer helps has reached rounding, or is stuck: `finish` tells which by the residual.
        stalled = ~contracting & ~_helps(own, following, gap)
        # A step of minimisation that widens the gap is taken back, and Newton goes on from where it started.
        widened = contracting & (state.steps > 0) & ~(gap < own.gap) & ~done
        result = choose(done | stalled, Result.success, Result.running)
        result = choose(finite | widened, result, Result.nonfinite)
        good = finite & ~stalled & ~widened
        # Newton once, Newton to the end: a step of minimisation would expand what a good Newton step has shrunk.
        still = contracting & ~widened & (ratio <= CONTRACTING)
        # The first step, which evaluates M0, is its own predecessor: nothing is known of a change yet.
        before = choose(state.steps == 0, (following, response.M), (M, own.response.M))
        taken = _Own(response, gap, ratio, xp.stack(before), limit, still)
        M, own = choose(good, (following, taken), (M, own._replace(contracting=contracting & ~widened)))
        return State(M, state.steps + 1, result, own)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        residual = self._residual(problem, state)
        unfinished = Result.running if stopped else Result.not_converged
        failed = choose(ended(state.result, Result.nonfinite), Result.nonfinite, unfinished)
        result = choose(residual <= self.accuracy(problem, state.M.dtype), Result.success, failed)
        return result, {
            "residual": residual,
            "unique": state.own.response.unique,
            "rate": state.own.ratio,
            "rescued": numerics(state.M)[0].asarray(False),
        }

    def _enough(self, problem: PerformativeProblem, dtype: Any) -> float:
        """The gap, relative to ‖M‖, at which a policy is taken for stable: not one that is rounding."""
        return max(0.1 * self.accuracy(problem, dtype), ROUNDINGS * float(np.finfo(dtype).eps))

    def _residual(self, problem: PerformativeProblem, state: State) -> Any:
        """Of the last policy: a by-product of its response, where there is one."""
        M, known = state.M, state.own.response.residual
        if known is None:
            return residual_of(problem, M, M)
        return cond(state.steps > 0, lambda: known, lambda: residual_of(problem, M, M))


def _limit(M: Any, response: Any) -> Any:
    """Of ‖M‖ for Newton's steps, by what the first step met."""
    return FAR * (1 + frobenius(M) + frobenius(response))


def _helps(own: _Own, M: Any, gap: Any) -> Any:
    """Whether a Newton step does. Where Φ' has the eigenvalue 1 up to rounding, it points to infinity, where every
    relative gap is small: not that far."""
    return (gap < own.gap) & (frobenius(M) <= own.limit)


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
