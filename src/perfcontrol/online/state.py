"""What a controller knows between two calls: the policy that acts, the episodes since the last step, the log."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from perfcontrol._checks import fail
from perfcontrol._programs import Numbers
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.base import State

LOGGED = 1000  # episodes that the log looks back


class Episodes(eqx.Module):
    """The draws of the episodes that the next step learns from: x_0 (b, n), w (b, T, n) and Δ (b, T, n, p)."""

    x0: Numbers
    w: Numbers
    matrices: Numbers


class Progress(eqx.Module):
    """Where the plant is: time t, episodes kept since the last step, x_t, the last w_{t-1}, ..., w_{t-H} (H, n)."""

    t: Numbers
    kept: Numbers
    x: Numbers
    memory: Numbers
    episodes: Episodes


@dataclass(frozen=True)
class Entry:
    """One line of the log, about the end of one episode.

    Attributes:
        episode: its number, from 0.
        deployed: whether a new policy acts from now on.
        reason: in words; where the last policy stays, why.
        cost: of that episode under the policy that acted; None where it is not finite.
    """

    episode: int
    deployed: bool
    reason: str
    cost: float | None

    def __str__(self) -> str:
        verdict = "deployed" if self.deployed else "kept the last policy"
        return f"episode {self.episode}: {verdict}: {self.reason}"


class Limits(NamedTuple):
    """What the gate goes by, None where it does not look.

    cost: the predicted cost that no policy may exceed. step: the largest step size. refusal: why the certificate
    lets nothing pass, in words.
    """

    cost: float | None = None
    step: float | None = None
    refusal: str | None = None


class ControllerState(eqx.Module):
    """Made by `Controller.init`; immutable.

    Attributes:
        deployed: the policy that acts and that the plant reacts to, free parameters.
        learner: of the solver.
        progress: of the current episode.
        episode: how many episodes have ended.
        limits: what the gate goes by, settled at the start; None without a gate.
        log: an `Entry` for each of the last 1000 episodes, the newest last.
    """

    deployed: Numbers
    learner: State
    progress: Progress
    episode: Numbers
    limits: Limits | None = eqx.field(static=True)
    log: tuple[Entry, ...] = eqx.field(static=True)


def check_state(state: Any) -> ControllerState:
    """`state` itself; raises InputError for anything else."""
    if not isinstance(state, ControllerState):
        required = "be the state of a controller"
        raise fail(
            "state", type(state).__name__, required, "Begin with controller.init(), and pass on what comes back."
        )
    return state


def first_progress(problem: PerformativeProblem, batch: int) -> Progress:
    """Before the first episode; the horizon is finite."""
    n, T, dtype = problem.state_size, problem.horizon, problem.dtype
    width = problem.perturbation.columns(n, problem.input_size)
    matrices = np.zeros((batch, T, n, width), dtype)
    episodes = Episodes(np.zeros((batch, n), dtype), np.zeros((batch, T, n), dtype), matrices)
    zero = np.zeros((), int)
    return Progress(zero, zero, np.zeros(n, dtype), np.zeros((problem.memory, n), dtype), episodes)
