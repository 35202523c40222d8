"""A stable policy by following a curve that leads to one from any start: slower than `StablePoint`, hard to stop.

The anchor a = M_0 solves M = (1-λ) a + λ Φ(M) at λ = 0; a stable policy solves it at λ = 1. On a compact convex set,
where Φ is smooth, the curve of solutions through (a, 0) reaches λ = 1 for almost every a (Chow, Mallet-Paret and Yorke
1978): wherever repeated minimisation runs away, and wherever Newton's method starts too far off. The curve may turn
back in λ on its way, so it is followed by arc length: a step along the tangent, then Newton steps across it.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import check_tolerance, fail
from perfcontrol._linalg import frobenius
from perfcontrol.evaluate.best_response import DENSE_LIMIT, respond, response_pushforward
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.loop import State, start
from perfcontrol.solvers.result import Result

CORRECTIONS = 6  # Newton steps across the curve before a step along it counts as too long
STRAIGHT = 0.9  # least cosine between the tangents at both ends of a step, unless it is shorter than BEND
FIRST, LONGEST, BEND, SHORTEST = 0.05, 0.5, 1e-4, 1e-9  # steps, relative to the scale of the first tangent


class _Own(eqx.Module):
    level: Array  # λ
    tangent: Array  # (p+1,), unit
    length: Array  # of the next step along the curve
    scale: Array  # ‖(Φ(a) - a, 1)‖
    anchor: Array
    residual: Array
    unique: Array


class Continuation(AbstractExactSolver):
    """A performatively stable policy by continuation from M_0; for bounded sets, where repeated minimisation fails.

    Needs a quadratic cost and known moments, and works with matrices of the policy's size: for up to 2048 free
    parameters. On an unbounded set there may be no stable policy, or the curve may leave for infinity. `.stats`:
    `residual` (relative natural residual), `unique` (of the best response), `level` (λ reached).

    Args:
        tolerance: None for 1e-11 in float64, 1e-5 in float32.
        max_steps: at most so many steps along the curve.

    Raises:
        InputError: more free parameters than can be held as a matrix; cost or perturbation without closed moments.

    References:
        Not in the paper; docs: theory, "Existence".
    """

    def __init__(self, tolerance: float | None = None, max_steps: int = 500):
        super().__init__(tolerance, max_steps)

    def check(self, problem: PerformativeProblem) -> None:
        super().check(problem)
        size = problem.initial_policy().size
        if size > DENSE_LIMIT:
            raise fail("problem", f"{size} free parameters", f"have at most {DENSE_LIMIT}", "Use pc.StablePoint().")

    def init(self, problem: PerformativeProblem, M0: Array) -> State:
        zero, far = jnp.zeros((), M0.dtype), jnp.asarray(jnp.inf, M0.dtype)
        along = jnp.zeros(M0.size + 1, M0.dtype).at[-1].set(1)
        # The first step has no length: it evaluates the anchor and finds the curve's tangent there.
        return start(M0, _Own(zero, along, zero, zero, M0, far, jnp.asarray(True)))

    def step(self, problem: PerformativeProblem, state: State, key: Array | None) -> State:
        own, first = state.own, state.steps == 0
        tolerance = check_tolerance(self.tolerance, problem.dtype)
        eps = jnp.finfo(state.M.dtype).eps
        here = jnp.append(state.M.reshape(-1), own.level)
        ahead = here + own.length * own.tangent
        # A step that would pass λ = 1 ends there, and the corrections stay there.
        last = ahead[-1] >= 1
        ahead = jnp.where(last, here + (1 - own.level) / own.tangent[-1] * own.tangent, ahead)
        border = jnp.where(last, jnp.zeros_like(here).at[-1].set(1), own.tangent)
        size = 1 + frobenius(own.anchor)
        enough = jnp.where(last, jnp.minimum(0.01 * tolerance, 1e3 * eps), jnp.sqrt(eps)) * size

        def correct(carry: Any) -> Any:
            y, move, *_, count = carry
            y = y - move
            gap, slope, residual, unique = _curve(problem, own.anchor, y)
            move = jnp.linalg.solve(jnp.concatenate([slope, border[None]]), jnp.append(gap, 0))
            return y, move, slope, jnp.linalg.norm(gap), residual, unique, count + 1

        def unfinished(carry: Any) -> Array:
            _, move, *_, gap, _, _, count = carry
            return (count == 0) | ((gap > enough) & jnp.all(jnp.isfinite(move)) & (count < CORRECTIONS))

        nothing = jnp.zeros((here.size - 1, here.size), here.dtype)
        began = (ahead, jnp.zeros_like(here), nothing, own.residual, own.residual, own.unique, jnp.asarray(0))
        y, _, slope, gap, residual, unique, count = jax.lax.while_loop(unfinished, correct, began)
        # The corrections at λ = 1 may stop at what rounding allows: there the natural residual decides.
        arrived = last & (residual <= tolerance)
        tangent, scale = _tangent(slope, border)
        scale = jnp.where(first, scale, own.scale)
        # Not across a fold: a step whose corrections lead far away has met another part of the curve.
        near = jnp.linalg.norm(y - ahead) <= 0.5 * jnp.linalg.norm(ahead - here) + enough
        short = own.length < BEND * scale
        straight = first | short | (tangent @ own.tangent >= STRAIGHT)
        good = arrived | (~last & (gap <= enough) & near & straight & jnp.all(jnp.isfinite(tangent)))
        longer = jnp.minimum(jnp.where(count <= 3, 2, 1) * own.length, LONGEST * scale)
        length = jnp.where(good, jnp.where(first, FIRST * scale, longer), own.length / 2)
        stuck = ~good & (first | (length < SHORTEST * scale))
        M = problem.feasible_set.project(y[:-1].reshape(state.M.shape))
        return State(
            jnp.where(good, M, state.M),
            state.steps + 1,
            Result.where(arrived | stuck, Result.success, Result.running),  # `finish` tells which by the residual
            _Own(
                jnp.where(good, y[-1], own.level),
                jnp.where(good, tangent, own.tangent),
                length,
                scale,
                own.anchor,
                jnp.where(good, residual, own.residual),
                jnp.where(good, unique, own.unique),
            ),
        )

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Array]]:
        own = state.own
        unfinished = Result.running if stopped else Result.not_converged
        arrived = (own.level >= 1) & (own.residual <= check_tolerance(self.tolerance, problem.dtype))
        stats = {"residual": own.residual, "unique": own.unique, "level": own.level}
        return Result.where(arrived, Result.success, unfinished), stats


def _tangent(slope: Array, border: Array) -> tuple[Array, Array]:
    """The unit null vector of the Jacobian (p, p+1) that goes on along the curve, and its length before scaling.

    Along the whole curve, folds and kinks included, det [slope; tangent] keeps the sign that it has at λ = 0.
    """
    end = jnp.zeros_like(border).at[-1].set(1)
    tangent = jnp.linalg.solve(jnp.concatenate([slope, border[None]]), end)
    scale = jnp.linalg.norm(tangent)
    sign, _ = jnp.linalg.slogdet(jnp.concatenate([slope, tangent[None] / scale]))
    return sign * tangent / scale, scale


def _curve(problem: PerformativeProblem, anchor: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """M - (1-λ) a - λ Φ(M) at y = (M, λ), its Jacobian (p, p+1), and what the best response says of itself."""
    shape, p = anchor.shape, anchor.size
    eye = jnp.eye(p, dtype=y.dtype)
    # Corrections may leave the set, where the perturbation's law need not exist: Φ sees the nearest point of it.
    M, inward = jax.linearize(problem.feasible_set.project, y[:-1].reshape(shape))
    response = respond(problem, M)
    pushforward = response_pushforward(problem, M, response.M)
    image = jax.vmap(lambda row: pushforward(inward(row.reshape(shape))).reshape(-1))(eye).T
    away = (response.M - anchor).reshape(-1)
    gap = y[:-1] - anchor.reshape(-1) - y[-1] * away
    slope = jnp.concatenate([eye - y[-1] * image, -away[:, None]], axis=1)
    return gap, slope, response.residual, response.unique
