"""A step of RSGD from observed episodes instead of simulated ones."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol._programs import Numbers, program
from perfcontrol.evaluate.adjoint import path_gradient
from perfcontrol.evaluate.rollout import cut_off
from perfcontrol.online.observing import replay
from perfcontrol.online.state import Episodes
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import RSGD, AbstractGradient, Pathwise, Result
from perfcontrol.solvers.base import State


class Observed(AbstractGradient):
    """The path gradient of M along what it would have met in the observed episodes: `pc.Pathwise` without drawing.

    The draws are those of the world that reacted to the deployed policy, and do not depend on the policy that acted.
    """

    episodes: Episodes

    @property
    def needs_key(self) -> bool:
        return False

    def __call__(self, problem: PerformativeProblem, M: Array, deployed: Array, key: Any, batch: int) -> Array:
        return jnp.mean(jax.vmap(lambda path: path_gradient(problem, path))(replay(problem, M, self.episodes)), axis=0)


def check_solver(problem: PerformativeProblem, solver: Any) -> tuple[RSGD, PerformativeProblem]:
    """The solver, and the problem whose horizon is that of an episode; raises where it cannot learn from a plant."""
    if not isinstance(solver, RSGD):
        required = "be pc.RSGD: other methods need the model alone, not the plant"
        raise fail("solver", type(solver).__name__, required, "Solve the model by pc.solve, and start from init(M0=M).")
    if not isinstance(solver.gradient, Pathwise):
        got = f"RSGD with {type(solver.gradient).__name__}"
        raise fail(
            "solver", got, "take its gradients from observed paths", "Leave gradient out, or pass pc.Pathwise()."
        )
    solver.check(problem)
    return solver, cut_off(problem, solver.truncation)[0]


@program
def learn(problem: PerformativeProblem, solver: RSGD, learner: State, episodes: Episodes) -> State:
    """The learner after one step from these episodes."""
    settings = {name: getattr(solver, name) for name in ("step_size", "batch", "schedule", "transform", "truncation")}
    observing = RSGD(solver.steps, gradient=Observed(episodes), average=solver.average or False, **settings)
    return observing.step(problem, learner, None)


def iterate(learner: State) -> Numbers:
    """The newest policy, which is not `M` where iterates are averaged."""
    return learner.M if learner.own.tally is None else learner.own.tally.iterate


def taken_back(before: State, M: Numbers) -> State:
    """The learner before a step that was not accepted, at the policy M, the step counted all the same."""
    where = [lambda s: s.steps, lambda s: s.own.count, lambda s: s.result]
    values = [before.steps + 1, before.own.count + 1, Result.running]
    where.append((lambda s: s.M) if before.own.tally is None else (lambda s: s.own.tally.iterate))
    return eqx.tree_at(lambda s: [w(s) for w in where], before, [*values, M])
