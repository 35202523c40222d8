"""A stable policy by following a curve that leads to one from any start: slower than `StablePoint`, hard to stop.

The anchor a = M_0 solves M = (1-λ) a + λ Φ(M) at λ = 0; a stable policy solves it at λ = 1. On a compact convex set,
where Φ is smooth, the curve of solutions through (a, 0) reaches λ = 1 for almost every a (Chow, Mallet-Paret and Yorke
1978): wherever repeated minimisation runs away, and wherever Newton's method starts too far off. The curve may turn
back in λ on its way, so it is followed by arc length: a step along the tangent, then Newton steps across it.
"""

from typing import Any

import equinox as eqx

from perfcontrol._checks import fail
from perfcontrol._linalg import frobenius, solve
from perfcontrol._programs import Numbers, choose, cond, numerics, while_loop
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import residual_of, respond, response_jacobian
from perfcontrol.response.estimate import SampleAverage
from perfcontrol.response.projected import nearest, projection_slope
from perfcontrol.response.quadratic import DENSE_LIMIT
from perfcontrol.sets import Unconstrained
from perfcontrol.solvers.base import State, start
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.result import Result

CORRECTIONS = 6  # Newton steps across the curve before a step along it counts as too long
STRAIGHT = 0.9  # least cosine between the tangents at both ends of a step, unless it is shorter than BEND
FIRST, LONGEST, BEND, SHORTEST = 0.05, 0.5, 1e-4, 1e-9  # steps, relative to the scale of the first tangent


class _Own(eqx.Module):
    level: Numbers  # λ
    tangent: Numbers  # (p+1,), unit
    length: Numbers  # of the next step along the curve
    scale: Numbers  # ‖(Φ(a) - a, 1)‖
    anchor: Numbers
    unique: Numbers


class Continuation(AbstractExactSolver):
    """A performatively stable policy by continuation from M_0; for bounded sets, where repeated minimisation fails.

    Exact or sampled like `StablePoint`; works with matrices of the policy's size: for up to 2048 free
    parameters. On an unbounded set there may be no stable policy, or the curve may leave for infinity. Where
    constraints become active or cease to be, the curve has a kink: steps shrink there and turn to the far side's
    tangent. That they arrive is proved for smooth Φ only; through kinks it is what tests show. `.stats`:
    `residual` (relative natural residual), `unique` (of the best response), `level` (λ reached).

    Args:
        tolerance: None for 1e-11 in float64, 1e-5 in float32; where responses are sampled, the relative standard
            error of the answer, None for 1e-2.
        max_steps: at most so many steps along the curve.
        sampling: how many paths sampled responses may use; None for `SampleAverage()`.

    Raises:
        InputError: more free parameters than can be held as a matrix; cost or perturbation without closed moments.

    References:
        Not in the paper; docs: theory, "Existence".
    """

    def __init__(self, tolerance: float | None = None, max_steps: int = 500, sampling: SampleAverage | None = None):
        super().__init__(tolerance, max_steps, sampling)

    def check(self, problem: PerformativeProblem) -> None:
        super().check(problem)
        size = problem.initial_policy().size
        if size > DENSE_LIMIT:
            raise fail("problem", f"{size} free parameters", f"have at most {DENSE_LIMIT}", "Use pc.StablePoint().")

    def init(self, problem: PerformativeProblem, M0: Any) -> State:
        xp, _ = numerics(M0)
        zero = xp.zeros((), M0.dtype)
        along = xp.eye(M0.size + 1, dtype=M0.dtype)[-1]
        # The first step has no length: it evaluates the anchor and finds the curve's tangent there.
        return start(M0, _Own(zero, along, zero, zero, M0, xp.asarray(True)))

    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        own, first = state.own, state.steps == 0
        xp, _ = numerics(problem, state)
        tolerance = self.accuracy(problem, state.M.dtype)
        eps = xp.finfo(state.M.dtype).eps
        here = xp.append(state.M.reshape(-1), own.level)
        end = xp.eye(here.size, dtype=here.dtype)[-1]
        ahead = here + own.length * own.tangent
        # A step that would pass λ = 1 ends there, and the corrections stay there.
        last = ahead[-1] >= 1
        rest = (1 - own.level) / xp.where(own.tangent[-1] == 0, 1, own.tangent[-1])
        ahead = xp.where(last, here + rest * own.tangent, ahead)
        border = xp.where(last, end, own.tangent)
        size = 1 + frobenius(own.anchor)
        enough = xp.where(last, xp.minimum(0.01 * tolerance, 1e3 * eps), xp.sqrt(eps)).astype(size.dtype) * size

        def correct(carry: Any) -> Any:
            y, move, _, opening, *_, count = carry
            y = y - move
            gap, slope, unique = _curve(problem, own.anchor, y)
            move = solve(xp.concatenate([slope, border[None]]), xp.append(gap, xp.zeros((), gap.dtype)))
            opening = xp.where(count == 0, slope, opening)
            return y, move, slope, opening, xp.linalg.norm(gap), unique, count + 1

        def unfinished(carry: Any) -> Any:
            _, move, *_, gap, _, count = carry
            return (count == 0) | ((gap > enough) & xp.all(xp.isfinite(move)) & (count < CORRECTIONS))

        nothing = xp.zeros((here.size - 1, here.size), here.dtype)
        far = xp.asarray(xp.inf, here.dtype)
        began = (ahead, xp.zeros_like(here), nothing, nothing, far, own.unique, xp.asarray(0))
        y, _, slope, opening, gap, unique, count = while_loop(unfinished, correct, began)
        M = nearest(problem.feasible_set, y[:-1].reshape(state.M.shape))
        # The corrections at λ = 1 may stop at what rounding allows: there the natural residual decides.
        arrived = cond(last, lambda: residual_of(problem, M, M) <= tolerance, lambda: xp.asarray(False))
        tangent, scale = _tangent(slope, border, end)
        scale = xp.where(first, scale, own.scale)
        # Not across a fold: a step whose corrections lead far away has met another part of the curve.
        near = xp.linalg.norm(y - ahead) <= 0.5 * xp.linalg.norm(ahead - here) + enough
        short = own.length < BEND * scale
        straight = first | short | (tangent @ own.tangent >= STRAIGHT)
        good = arrived | (~last & (gap <= enough) & near & straight & xp.all(xp.isfinite(tangent)))
        longer = xp.minimum(xp.where(count <= 3, 2, 1).astype(scale.dtype) * own.length, LONGEST * scale)
        length = xp.where(good, xp.where(first, FIRST * scale, longer), own.length / 2)
        stuck = ~good & (first | (length < SHORTEST * scale))
        ended = choose(arrived | stuck, Result.success, Result.running)  # `finish` tells which by the residual
        missing = stuck & xp.all(xp.isfinite(y)) & ~xp.all(xp.isfinite(slope))
        ended = choose(missing, Result.not_differentiable, ended)
        # At a kink the curve may turn so sharply that no step along the old tangent meets it: try that of the far side.
        far_side, _ = _tangent(opening, border, end)
        turns = short & ~last & xp.all(xp.isfinite(far_side))
        moved = choose(
            good,
            (M, y[-1], tangent, unique),
            (state.M, own.level, xp.where(turns, far_side, own.tangent), own.unique),
        )
        kept = _Own(moved[1], moved[2], length, scale, own.anchor, moved[3])
        return State(moved[0], state.steps + 1, ended, kept)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        own = state.own
        residual = residual_of(problem, state.M, state.M)
        unfinished = Result.running if stopped else Result.not_converged
        arrived = (own.level >= 1) & (residual <= self.accuracy(problem, state.M.dtype))
        stats = {"residual": residual, "unique": own.unique, "level": own.level}
        unfinished = choose(state.result == Result.not_differentiable, Result.not_differentiable, unfinished)
        return choose(arrived, Result.success, unfinished), stats


def _tangent(slope: Any, border: Any, end: Any) -> tuple[Any, Any]:
    """The unit null vector of the Jacobian (p, p+1) that goes on along the curve, and its length before scaling.

    Along the whole curve, folds and kinks included, det [slope; tangent] keeps the sign that it has at λ = 0.
    """
    xp, _ = numerics(slope)
    tangent = solve(xp.concatenate([slope, border[None]]), end)
    scale = xp.linalg.norm(tangent)
    sign, _ = xp.linalg.slogdet(xp.concatenate([slope, tangent[None] / scale]))
    return sign * tangent / scale, scale


def _curve(problem: PerformativeProblem, anchor: Any, y: Any) -> tuple[Any, Any, Any]:
    """M - (1-λ) a - λ Φ(M) at y = (M, λ), its Jacobian (p, p+1), and whether the best response is unique."""
    xp, _ = numerics(problem, anchor, y)
    point = y[:-1].reshape(anchor.shape)
    # Corrections may leave the set, where the perturbation's law need not exist: Φ sees the nearest point of it.
    M = nearest(problem.feasible_set, point)
    response = respond(problem, M)
    image = response_jacobian(problem, M, response.M)
    if not isinstance(problem.feasible_set, Unconstrained):
        image = image @ projection_slope(problem.feasible_set, point)
    away = (response.M - anchor).reshape(-1)
    gap = y[:-1] - anchor.reshape(-1) - y[-1] * away
    slope = xp.concatenate([xp.eye(anchor.size, dtype=y.dtype) - y[-1] * image, -away[:, None]], axis=1)
    return gap, slope, response.unique
