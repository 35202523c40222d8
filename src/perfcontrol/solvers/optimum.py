"""The performatively optimal policy: the cheapest once the world has reacted to it.

C_T(M; M) need not be convex in M. Spectral projected gradient steps descend from several policies at once, the stable
and the naive one among them; Newton steps on the natural residual of the total derivative finish the cheapest.
"""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import check_integer
from perfcontrol._linalg import frobenius, solve
from perfcontrol._programs import Numbers, choose, cond, numerics, on_host, program
from perfcontrol.evaluate import exact
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import foresight, residual_of, respond
from perfcontrol.response import step_of as exact_step
from perfcontrol.response.estimate import SampleAverage
from perfcontrol.response.foresight import Foreseen
from perfcontrol.response.projected import nearest, projection_slope
from perfcontrol.response.quadratic import DENSE_LIMIT
from perfcontrol.response.sampled import Uncertainty
from perfcontrol.solvers.base import State, start
from perfcontrol.solvers.descent import descend
from perfcontrol.solvers.exact_solver import AbstractExactSolver
from perfcontrol.solvers.result import Result
from perfcontrol.solvers.solve import solve as run
from perfcontrol.solvers.stable_point import StablePoint

DESCENT = 200  # steps of descent from every start
FURTHER = 50  # steps of descent where a Newton step does not help
ROUGHLY = 1e-4  # relative moves at which descent hands over
COST_NOISE = 0.01  # rounding of a cost relative to √eps: costs cancel, and leaving the set by rounding moves them
RETRAININGS = 5
LEAST = 3  # starts: M_0, the stable and the naive policy


class _Own(eqx.Module):
    best: Numbers  # the cheapest policy so far
    value: Numbers
    gradient: Numbers
    step: Numbers  # η = 1/‖Hessian of C_T(·; M)‖ where the descent ended
    scale: Numbers  # of moves


class PerformativeOptimum(AbstractExactSolver):
    """M^PO = argmin over the feasible set of C_T(M; M), by the exact total derivative from several starts.

    Exact for a quadratic cost and known moments; else given a key, by sample averages with common random numbers (where
    only the probabilities of draws move, as in `FinitePerturbation`, by weighing them). The answer never costs more
    than the start, the stable policy (or where `StablePoint` ends in search of it) or the naive one, Φ(M_0), exactly or
    on the sample. It is stationary; that it is the cheapest of all
    is what `pc.optimality_bound` can prove. `.stats`: `cost` C_T(M; M), `residual` (relative natural residual of the
    total gradient), `unique` (whether the answer is an isolated stationary policy; with more than 2048 free
    parameters, where no Hessian is held, always True).

    Args:
        starts: how many policies to descend from; M_0, the stable and the naive policy are always among them.
        tolerance: of the residual; None for 1e-11 in float64, 1e-5 in float32; of sampled answers the relative standard
            error, None for 1e-2.
        max_steps: at most so many Newton steps.
        sampling: how many paths sampled costs may use; None for `SampleAverage()`.

    Raises:
        InputError: starts < 1; cost or perturbation without closed moments, and no key.

    References:
        Not in the paper beyond its definition (POC); docs: theory, "The performative optimum".
    """

    starts: int = eqx.field(static=True)

    def __init__(
        self,
        starts: int = 8,
        tolerance: float | None = None,
        max_steps: int = 60,
        sampling: SampleAverage | None = None,
    ):
        super().__init__(tolerance, max_steps, sampling)
        self.starts = check_integer("starts", starts, 1)

    def sampled(self, problem: PerformativeProblem, key: Any, samples: Any, M: Any) -> Foreseen:
        return Foreseen(problem, key, samples, M)

    def uncertainty(self, world: Any, M: Any) -> Uncertainty:
        return foresight.uncertainty(world, M)

    def init(self, problem: PerformativeProblem, M0: Any) -> State:
        points = _starts(problem, M0, max(self.starts, LEAST))
        xp, _ = numerics(problem, points)
        scale = xp.max(xp.sqrt(xp.sum(points**2, axis=(1, 2, 3))))
        scale = xp.where(scale > 0, scale, 1)
        best, value, gradient = _descended(problem, points, _step_of(problem, M0), scale, ROUGHLY, DESCENT)
        return start(M0, _Own(best, value, gradient, _step_of(problem, best), scale))

    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        own = state.own
        xp, _ = numerics(problem, state)
        M, value, gradient = own.best, own.value, own.gradient
        finite = xp.isfinite(value)
        tolerance = self.accuracy(problem, state.M.dtype)
        gap = frobenius(_gap(problem, M, gradient, own.step))
        rounding = COST_NOISE * xp.sqrt(xp.finfo(gap.dtype).eps) * xp.abs(value)
        lengths = xp.asarray([0.25**i for i in range(max(self.starts, LEAST))], M.dtype)
        trials, values, gradients = _trials(problem, M, gradient, own.step, lengths)
        # Near the answer values differ by rounding alone: there the full step counts if it shrinks the residual.
        newton_gap = frobenius(_gap(problem, trials[0], gradients[0], own.step))
        lowest = xp.argmin(xp.where(xp.isfinite(values), values, xp.inf))
        closer = (newton_gap < gap) & (values[0] <= value + rounding)
        lower = values[lowest] < value - rounding
        chosen = xp.where(closer, 0, lowest)

        def by_newton() -> tuple[Any, Any, Any]:
            return trials[chosen], values[chosen], gradients[chosen]

        def by_descent() -> tuple[Any, Any, Any]:
            again = xp.broadcast_to(M, trials.shape)
            return _descended(problem, again, own.step * lengths, own.scale, 0.1 * tolerance, FURTHER)

        size = frobenius(M)
        size = xp.where(size > 0, size, 1)
        arrived = gap <= 0.1 * tolerance * size
        best, cost, slope = cond(closer | lower | arrived, by_newton, by_descent)
        better_gap = frobenius(_gap(problem, best, slope, own.step))
        helps = finite & ((better_gap < gap) | (cost < value - rounding))
        done = gap <= 0.01 * tolerance * size
        # A step that no longer helps has reached rounding, or is stuck: `finish` tells which by the residual.
        result = choose(done | ~helps, Result.success, Result.running)
        result = choose(finite, result, Result.nonfinite)
        kept = choose(helps, _Own(best, cost, slope, own.step, own.scale), own)
        return State(kept.best, state.steps + 1, result, kept)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        M = state.M
        values, gradients = _values_and_gradients(problem, M[None])
        cost, gradient = values[0], gradients[0]
        residual = _residual(problem, M, gradient, state.own.step)
        unfinished = Result.running if stopped else Result.not_converged
        failed = choose(state.result == Result.nonfinite, Result.nonfinite, unfinished)
        result = choose(residual <= self.accuracy(problem, state.M.dtype), Result.success, failed)
        xp, _ = numerics(problem, M)
        unique = xp.asarray(True)
        if M.size <= DENSE_LIMIT:
            system = _newton_system(problem, M, gradient, state.own.step)
            values = xp.linalg.svd(xp.where(xp.isfinite(system), system, 0), compute_uv=False)
            unique = values[-1] > 100 * M.size * xp.finfo(values.dtype).eps * xp.maximum(values[0], 1)
        return result, {"cost": cost, "residual": residual, "unique": unique}


def _values_and_gradients(problem: PerformativeProblem, policies: Any) -> tuple[Any, Any]:
    """C_T(M; M) and its total derivative at stacked policies, exactly or by sample averages."""
    known = foresight.values_and_gradients if isinstance(problem, Foreseen) else exact.values_and_total_gradients
    return known(problem, policies)


def _hessian(problem: PerformativeProblem, M: Any) -> Any:
    return foresight.curvature(problem, M)[0] if isinstance(problem, Foreseen) else exact.total_hessian(problem, M)


def _step_of(problem: PerformativeProblem, M: Any) -> Any:
    return foresight.step_of(problem, M) if isinstance(problem, Foreseen) else exact_step(problem, M)


def _residual(problem: PerformativeProblem, M: Any, gradient: Any, step: Any) -> Any:
    """The relative natural residual of the total gradient."""
    if not isinstance(problem, Foreseen):
        return residual_of(problem, M, M, gradient)
    size = frobenius(M)
    xp, _ = numerics(problem, M)
    return frobenius(_gap(problem, M, gradient, step)) / xp.where(size > 0, size, 1)


def _starts(problem: PerformativeProblem, M0: Any, count: int) -> Any:
    """M_0, the stable policy, the naive one, and others about them; projected, (count, ...)."""
    naive = respond(problem, M0).M
    stable = _retrained(problem, naive) if isinstance(problem, Foreseen) else _stable(problem, M0)
    stable, naive = on_host((stable, naive))
    xp, _ = numerics(problem, M0, stable, naive)
    naive, stable = (xp.where(xp.all(xp.isfinite(M)), M, M0) for M in (naive, stable))
    size = xp.maximum(frobenius(stable), frobenius(naive))
    size = xp.where(size > 0, size, 1)
    points = [M0, stable, naive, 0 * M0, naive / 2, stable / 2]
    for k in range(max(0, count - len(points))):  # waves of ever higher frequency: the basis of the cosine transform
        wave = xp.cos(xp.pi * k * (xp.arange(M0.size, dtype=M0.dtype) + 0.5) / M0.size)
        points.append(((-1) ** k * size * wave / frobenius(wave)).reshape(M0.shape))
    return _feasible(problem, xp.stack(points[:count]).astype(M0.dtype))


def _stable(problem: PerformativeProblem, M0: Any) -> Any:
    return run(problem, StablePoint(), M0, throw=False).M


def _retrained(problem: Foreseen, naive: Any) -> Any:
    """Where a few best responses lead: near the stable policy of the sample."""
    M = naive
    for _ in range(RETRAININGS):
        M = respond(problem, M).M
    return M


@program
def _feasible(problem: PerformativeProblem, points: Any) -> Array:
    return jax.vmap(problem.feasible_set.project)(points)


@program
def _descent(
    problem: PerformativeProblem, points: Any, first_step: Any, scale: Any, tolerance: Any, limit: Any
) -> tuple[Array, Array, Array]:
    def objective(policies: Array) -> tuple[Array, Array]:
        return _values_and_gradients(problem, policies)

    return descend(objective, problem.feasible_set.project, points, first_step, scale, tolerance, limit)


def _descended(
    problem: PerformativeProblem, points: Any, first_step: Any, scale: Any, tolerance: float, limit: int
) -> tuple[Any, Any, Any]:
    """The cheapest policy that descent from these points leads to, its cost and total gradient."""
    # Limits as arrays: other ones compile nothing.
    ends = np.asarray(tolerance, points.dtype), np.asarray(limit)
    xp, _ = numerics(problem, points)
    steps = xp.broadcast_to(first_step, points.shape[:1])
    policies, values, gradients = _descent(problem, points, steps, scale, *ends)
    best = xp.argmin(values)
    return policies[best], values[best], gradients[best]


def _gap(problem: PerformativeProblem, M: Any, gradient: Any, step: Any) -> Any:
    return M - nearest(problem.feasible_set, M - step * gradient)


def _newton_system(problem: PerformativeProblem, M: Any, gradient: Any, step: Any) -> Any:
    """A generalised Jacobian (p, p) of the natural residual of the total gradient."""
    slope = projection_slope(problem.feasible_set, M - step * gradient)
    xp, _ = numerics(slope)
    eye = xp.eye(M.size, dtype=M.dtype)
    return eye - slope @ (eye - step * _hessian(problem, M))


def _trials(problem: PerformativeProblem, M: Any, gradient: Any, step: Any, lengths: Any) -> tuple[Any, Any, Any]:
    """Policies along the Newton step (the gradient step where none is held), their costs and total gradients."""
    gap = _gap(problem, M, gradient, step)
    xp, _ = numerics(problem, M, gap)
    direction = -gap
    if M.size <= DENSE_LIMIT:
        direction = -solve(_newton_system(problem, M, gradient, step), gap.reshape(-1)).reshape(M.shape)
    direction = xp.where(xp.all(xp.isfinite(direction)), direction, -gap)
    trials = _feasible(problem, M + lengths[:, None, None, None] * direction)
    return trials, *_values_and_gradients(problem, trials)
