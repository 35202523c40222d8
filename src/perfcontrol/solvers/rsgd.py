"""Repeated stochastic gradient descent: the paper's Algorithm 1."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import check_integer, check_parentheses, fail
from perfcontrol._functions import call
from perfcontrol._programs import Numbers, choose
from perfcontrol.evaluate.rollout import cut_off
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.averaging import Average, Tally, as_average
from perfcontrol.solvers.base import AbstractSolver, State, start
from perfcontrol.solvers.gradients import Pathwise
from perfcontrol.solvers.result import Result
from perfcontrol.solvers.schedules import Greedy
from perfcontrol.solvers.step_sizes import as_step_size, size_of

DIVERGENCE = 1e8  # growth of ‖M‖ over 1 + ‖M_0‖ at which a run is called divergent


class _Own(eqx.Module):
    count: Numbers
    deployments: Numbers
    deployed: Numbers
    threshold: Numbers
    transform_state: Any
    tally: Tally | None  # with averaging: the iterate too, the state's own M being the average


class RSGD(AbstractSolver):
    """M_{n+1} = Proj(M_n - η_n ∇J(M_n)), the gradient taken along paths of the world that reacts to M_n.

    Differentiates in the evaluated policy alone, so its fixed points are performatively stable policies, not
    performative optima. Unlike Algorithm 1 as printed, the terminal stage counts.

    Args:
        steps: N ≥ 1.
        step_size: a number, `pc.InverseStep(phi1, phi2)`, `pc.PowerStep(eta, alpha)`, or a function n -> η_n.
        batch: paths per step.
        gradient: `pc.Pathwise()`; `pc.Exact()` for the mean field, which is repeated gradient descent;
            `pc.EstimatedDynamics()` where perturbations are not observed; `pc.TwoPoint(radius)` where only costs are.
        schedule: `pc.Greedy()`, or `pc.Lazy(k)` to deploy every k-th iterate.
        transform: an optax-like gradient transformation (`init`, `update`), applied before the step size.
        truncation: T of the paths, for an infinite horizon and only there; gradients are then per stage, with a bias
            of the order 1/truncation. `pc.Exact()` needs none.
        average: True, or a `pc.Average`: `.M`, and with it the history, is the average of the iterates since a
            burn-in (before it, the iterate), and `stats["covariance"]` (p, p) estimates its covariance; best with
            `pc.PowerStep`. `pc.confidence_region` makes a region of it.

    A run whose iterate grows 1e8-fold ends as `Result.diverged`, one that meets a non-finite number as
    `Result.nonfinite`; both keep the last good iterate and the step where it happened.

    References:
        Algorithm 1; Theorem 1 for the step; for averages docs: theory, "Averaged iterates".
    """

    steps: int = eqx.field(static=True)
    step_size: Any
    batch: int = eqx.field(static=True)
    gradient: Any
    schedule: Any
    transform: Any = eqx.field(static=True)
    truncation: int | None = eqx.field(static=True)
    average: Average | None

    def __init__(
        self,
        steps: int,
        step_size: Any,
        batch: int = 1,
        gradient: Any = None,
        schedule: Any = None,
        transform: Any = None,
        truncation: int | None = None,
        average: bool | Average = False,
    ):
        self.steps = check_integer("steps", steps, 1)
        self.step_size = as_step_size(step_size)
        self.batch = check_integer("batch", batch, 1)
        self.gradient = Pathwise() if gradient is None else gradient
        self.schedule = Greedy() if schedule is None else schedule
        self.transform = transform
        for name, part, ability, example in (
            ("gradient", self.gradient, "check", "pc.Pathwise()"),
            ("schedule", self.schedule, "deploys", "pc.Greedy()"),
            ("transform", self.transform, "update", "optax.scale_by_adam()"),
        ):
            if part is None:
                continue
            check_parentheses(name, part, f"be an object such as `{example}`")
            if not hasattr(part, ability):
                raise fail(name, type(part).__name__, f"be an object such as `{example}`", f"Pass {example}.")
        self.truncation = None if truncation is None else check_integer("truncation", truncation, 1)
        self.average = as_average(average)
        if self.average is not None and transform is not None:
            raise fail(
                "transform",
                "a gradient transformation together with average",
                "be left out where iterates are averaged",
                "Leave out one of them: the covariance of the average is that of plain steps.",
            )

    @property
    def max_steps(self) -> int:
        return self.steps

    @property
    def needs_key(self) -> bool:
        return getattr(self.gradient, "needs_key", True)

    @property
    def draws_along(self) -> bool:
        return isinstance(self.gradient, Pathwise)

    @property
    def lanes(self) -> int | None:
        return getattr(self.gradient, "lanes", None)

    def check(self, problem: PerformativeProblem) -> None:
        self.gradient.check(problem)
        simulated, _ = self._simulated(problem)
        if self.average is not None:
            self.average.check(simulated, self.steps)

    def _simulated(self, problem: PerformativeProblem) -> tuple[PerformativeProblem, float]:
        """The problem that gradients are of, and their weight."""
        return cut_off(problem, self.truncation) if self.needs_key or self.truncation is not None else (problem, 1.0)

    def init(self, problem: PerformativeProblem, M0: Array) -> State:
        transform_state = None if self.transform is None else call("transform", self.transform.init, M0=M0)
        threshold = DIVERGENCE * (1 + jnp.sqrt(jnp.sum(M0**2)))
        tally = None if self.average is None else self.average.init(self._simulated(problem)[0], M0)
        return start(M0, _Own(jnp.zeros((), int), jnp.zeros((), int), M0, threshold, transform_state, tally))

    def step(self, problem: PerformativeProblem, state: State, key: Array | None) -> State:
        own = state.own
        M = state.M if own.tally is None else own.tally.iterate
        deploys = self.schedule.deploys(own.count)
        deployed = jnp.where(deploys, M, own.deployed)
        simulated, weight = self._simulated(problem)
        gradient = weight * self.gradient(simulated, M, deployed, key, self.batch)
        transform_state = own.transform_state
        if self.transform is not None:
            gradient, transform_state = call(
                "transform", self.transform.update, gradient=gradient, state=transform_state, policy=M
            )
        ahead = M - size_of(self.step_size, own.count).astype(M.dtype) * gradient
        following = problem.feasible_set.project(ahead)
        finite = jnp.all(jnp.isfinite(following))
        diverged = jnp.sqrt(jnp.sum(following**2)) > own.threshold
        good = finite & ~diverged
        result = Result.where(finite, Result.where(diverged, Result.diverged, Result.running), Result.nonfinite)
        kept, tally = choose(good, transform_state, own.transform_state), own.tally
        answer = jnp.where(good, following, M)
        if self.average is not None and own.tally is not None:
            moved = jnp.sqrt(jnp.sum((following - ahead) ** 2))
            grown = self.average.add(simulated, own.tally, own.count, self.steps, following, gradient, moved)
            tally = choose(good, grown, own.tally)
            answer = tally.mean
        return State(
            answer,
            state.steps + 1,
            result,
            _Own(own.count + 1, own.deployments + deploys, deployed, own.threshold, kept, tally),
        )

    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        # A fixed number of steps is what was asked for: reaching it, or the max_steps of `solve`, is success.
        result = choose(state.result == Result.running, Result.success, state.result)
        stats = {"deployments": state.own.deployments}
        if self.average is not None:
            simulated, weight = self._simulated(problem)
            tally = state.own.tally
            stats |= self.average.statistics(simulated, weight, tally, self.steps, self.step_size, self.needs_key)
        return result, stats
