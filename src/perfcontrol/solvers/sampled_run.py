"""The run of a solver whose best responses are sampled: it ends, the sample grows where its error is too large, on."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Key

from perfcontrol._linalg import frobenius
from perfcontrol._programs import Numbers, choose, cond, numerics
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response.estimate import SampleAverage, check_sampling, excess
from perfcontrol.response.foresight import Foreseen
from perfcontrol.response.sampled import Sampled
from perfcontrol.solvers.base import AbstractSolver, State, start
from perfcontrol.solvers.result import Result


class _Own(eqx.Module):
    inner: State
    origin: Numbers  # where the inner run set out
    samples: Numbers
    standard_error: Numbers  # policy_shape
    radius: Numbers


class SampledRun(AbstractSolver):
    """Another solver on sample averages with common random numbers: Φ_N in place of Φ, N grown as its error asks.

    Args:
        solver: the method.
        key: of the paths, the same at every iteration.
        tolerance: relative standard error of the answer; None for 0.01.
        sampling: sizes of samples.
    """

    solver: Any  # an AbstractExactSolver
    key: Key[Array, ""]
    tolerance: float | None = eqx.field(static=True)
    sampling: SampleAverage

    @property
    def max_steps(self) -> int:
        return self.solver.max_steps

    @property
    def needs_key(self) -> bool:
        return True

    @property
    def from_host(self) -> bool:
        return True

    def rescue(self, problem: PerformativeProblem) -> AbstractSolver | None:
        rescuer = self.solver.rescue(problem)
        return None if rescuer is None else SampledRun(rescuer, self.key, self.tolerance, self.sampling)

    def check(self, problem: PerformativeProblem) -> None:
        check_sampling(problem, self.tolerance)

    def _world(self, problem: PerformativeProblem, own: _Own) -> Sampled:
        return self.solver.sampled(problem, self.key, own.samples, own.origin)

    def init(self, problem: PerformativeProblem, M0: Any) -> State:
        xp, _ = numerics(M0)
        samples, far = xp.asarray(self.sampling.samples), xp.full(M0.shape, xp.inf, M0.dtype)
        inner = self.solver.init(self.solver.sampled(problem, self.key, samples, M0), M0)
        return start(M0, _Own(inner, M0, samples, far, far.reshape(-1)[0]))

    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        own = state.own
        world = self._world(problem, own)
        inner = self.solver.step(world, own.inner, key)
        moved = State(inner.M, state.steps + 1, state.result, eqx.tree_at(lambda o: o.inner, own, inner))
        return cond(inner.result == Result.running, lambda: moved, lambda: self._ended(problem, world, moved))

    def _ended(self, problem: PerformativeProblem, world: Sampled, state: State) -> State:
        """The same run with a larger sample where it ended well but its error is too large."""
        own, M = state.own, state.M
        xp, _ = numerics(problem, state)
        result, _ = self.solver.finish(world, own.inner, False)
        well = result == Result.success
        error = self.solver.uncertainty(world, M)
        over = xp.where(error.total > 0, excess(error, M, self.tolerance), 0)
        # Without an error to go by, as where I - Φ' is singular, more samples are all that can help.
        grows = well & ~(over <= 1) & (own.samples < self.sampling.limit)
        samples = xp.where(
            grows, self.sampling.following(own.samples, xp.where(xp.isfinite(over), over, 1)), own.samples
        )
        # Weighed draws are made where the run set out: an answer elsewhere than there is checked with draws of its own.
        away = frobenius(M - own.origin) > error.total
        again = grows | (well & (over <= 1) & away) if isinstance(world, Foreseen) and world.weighed else grows
        anew = self.solver.init(self.solver.sampled(problem, self.key, samples, M), M)
        ended = choose(well & ~(over <= 1), Result.undersampled, result)
        inner, origin = choose(again, (anew, M), (own.inner, own.origin))
        kept = _Own(inner, origin, samples, error.standard_error, error.radius)
        return State(M, state.steps, choose(again, Result.running, ended), kept)

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        own = state.own
        result, stats = self.solver.finish(self._world(problem, own), own.inner, stopped)
        cut = Result.running if stopped else Result.not_converged
        # A run that was growing its sample when it was stopped has not ended, whatever its last policy was worth.
        result = choose((state.result == Result.running) & (result == Result.success), cut, result)
        result = choose(state.result == Result.undersampled, Result.undersampled, result)
        extra = {"standard_error": own.standard_error, "confidence_radius": own.radius, "samples": own.samples}
        return result, stats | extra
