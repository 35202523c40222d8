"""The controller of a running plant: it acts, observes, learns between episodes, and deploys what its gate allows."""

import functools
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import as_array, check_key, check_shape, fail
from perfcontrol._fingerprint import fingerprint
from perfcontrol._programs import Numbers, known
from perfcontrol.online import files
from perfcontrol.online.gate import as_gate, endless
from perfcontrol.online.learning import check_solver, iterate, learn, taken_back
from perfcontrol.online.observing import act, costs, observe
from perfcontrol.online.state import LOGGED, ControllerState, Entry, Limits, Progress, check_state, first_progress
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.solvers import RSGD, Result
from perfcontrol.solvers.base import State
from perfcontrol.solvers.solve import check_feasible
from perfcontrol.solvers.step_sizes import size_of

SLACK = 1e-3  # between a state and the last x_next, relative: rounding of a sensor, and not a step left out


class Controller:
    """Acts on a running plant and learns from it: RSGD across episodes, one step for each `batch` of them.

        controller = pc.online.Controller(problem, pc.RSGD(steps=1000, step_size=0.01))
        state = controller.init(key=key)
        for x0 in starts:                      # one episode: T steps, then the last input
            x = x0
            for t in range(problem.horizon):
                u = controller.act(state, x)
                x_next, A = plant(x, u)        # A where it can be observed
                state = controller.observe(state, x, u, x_next, A)
                x = x_next
            controller.act(state, x)           # u_T
            state = controller.end_episode(state)

    Every method is pure: it returns a new state and changes none. With A observed the iterates are those of
    `pc.solve(problem, solver)` from the same draws. Else the perturbations are taken to be what the model expects:
    what they scatter counts as noise that does not grow with the state, and RSGD comes to rest elsewhere, the farther
    the more they scatter (as with `pc.EstimatedDynamics`).

    Args:
        problem: the model of the plant, nominal or fitted (`Fit.problem`).
        solver: `pc.RSGD` with its default gradient.
        gate: True for `pc.online.Gate()`: a new policy is deployed only where the model allows it, else the last one
            stays and `state.log` says why. False for none.

    Raises:
        InputError: another solver or gradient; an infinite horizon without `truncation`; a gate that asks for what the
            model does not know.
    """

    problem: PerformativeProblem
    solver: RSGD

    def __init__(self, problem: PerformativeProblem, solver: RSGD, gate: Any = True):
        self.problem = check_problem(problem)
        self.solver, self._finite = check_solver(problem, solver)
        n, m, perturbation = problem.state_size, problem.input_size, problem.perturbation
        self._sizes, self._dtype = (n, m, perturbation.columns(n, m)), np.dtype(problem.dtype)
        policy = jax.ShapeDtypeStruct(problem.lifted_shape, problem.dtype)
        mean = eqx.filter_eval_shape(lambda law, M: law.mean(M, self._finite.horizon), perturbation, policy)
        self._expects = mean is not None
        self.gate = as_gate(gate)
        if self.gate is not None:
            self.gate.check(problem, self.solver)

    def init(self, M0: Any = None, key: Any = None) -> ControllerState:
        """The state before the first episode.

        Args:
            M0: the policy to begin with, free parameters; None for the feasible one nearest to zero.
            key: JAX random key, as solvers take it; checked and not used, for a plant draws by itself. The samples of
                the gate are those of `pc.safe_step` when it is given no key.

        Raises:
            InputError: a policy of the wrong shape, outside the feasible set, or (with a gate) of unbounded cost.
        """
        problem = self.problem
        first = problem.initial_policy() if M0 is None else problem.check_policy("M0", M0)
        check_feasible("M0", problem, first)
        M0 = np.asarray(first)
        if key is not None:
            check_key(key)
        limits = None if self.gate is None else self.gate.limits(problem, self.solver, M0)
        return self._first(first, limits)

    def _first(self, M0: Any, limits: Limits | None) -> ControllerState:
        learner = jax.tree.map(np.asarray, self.solver.init(self.problem, M0))
        progress = first_progress(self._finite, self.solver.batch)
        return ControllerState(np.asarray(M0), learner, progress, np.zeros((), int), limits, ())

    def act(self, state: ControllerState, x: Any) -> Numbers:
        """u_t, (m,).

        Args:
            state: the state.
            x: x_t, (n,).

        Raises:
            InputError: a state of the wrong shape, or not finite.
        """
        x = self._read("x", x, (self._sizes[0],), ("n",))
        return act(self._finite, check_state(state).deployed, state.progress, x)

    def observe(self, state: ControllerState, x: Any, u: Any, x_next: Any, A: Any = None) -> ControllerState:
        """The state after one step of the plant.

        Args:
            state: the state.
            x: x_t, (n,).
            u: u_t, (m,), what the plant was given; it need not be what `act` asked for.
            x_next: x_{t+1}, (n,).
            A: the matrix A_t + Δ_t, (n, n), where it is observed; (n, n+m), with that of the input to its right,
                where perturbations act on [x; u]. None: what the model expects.

        Raises:
            InputError: wrong shapes, numbers that are not finite, a step left out or too many.
        """
        n, m, width = self._sizes
        x, x_next = self._read("x", x, (n,), ("n",)), self._read("x_next", x_next, (n,), ("n",))
        u = self._read("u", u, (m,), ("m",))
        if A is not None:
            A = self._read("A", A, (n, width), ("n", "n" if width == n else "n+m"))
        elif not self._expects:
            family = type(self.problem.perturbation).__name__
            raise fail("A", "None", f"be observed where the model, a {family}, expects nothing", "Pass A_t + Δ_t.")
        if known(check_state(state), x):
            self._check_order(state.progress, np.asarray(x))
        following = observe(self._finite, state.deployed, state.progress, x, u, x_next, A)
        return eqx.tree_at(lambda s: s.progress, state, following)

    def end_episode(self, state: ControllerState) -> ControllerState:
        """The state before the next episode: after a step of RSGD where the batch is complete.

        Args:
            state: the state after T observed steps.

        Raises:
            InputError: fewer steps than an episode has.
        """
        progress, batch = check_state(state).progress, self.solver.batch
        if progress.t < self._finite.horizon:
            raise fail(
                "state",
                f"{int(progress.t)} observed steps",
                f"have seen the {self._finite.horizon} of an episode",
                "Call observe for each step; to leave an episode out, go on from the state before it.",
            )
        kept = int(progress.kept) + 1
        cost = float(costs(self._finite, state.deployed, progress.episodes)[kept - 1])
        fresh = first_progress(self._finite, batch)
        if kept < batch:
            following = eqx.tree_at(lambda p: [p.kept, p.episodes], fresh, [np.asarray(kept), progress.episodes])
            learnt = state.learner, state.deployed, False, f"episode {kept} of {batch} for the next step"
        else:
            following, learnt = fresh, self._learnt(state)
        learner, deployed, new, reason = learnt
        entry = Entry(int(state.episode), new, reason, cost if np.isfinite(cost) else None)
        log = (*state.log, entry)[-LOGGED:]
        return ControllerState(np.asarray(deployed), learner, following, state.episode + 1, state.limits, log)

    def save(self, state: ControllerState, path: str | os.PathLike[str]) -> None:
        """Write the state to one file: whole or not at all, and on the disk when this returns.

        Args:
            state: the state, at any time of an episode.
            path: of the file; what is there is replaced.

        Raises:
            InputError: a state with numbers that are not finite.
            OSError: the file cannot be written.
        """
        files.save(check_state(state), path, self._owner)

    def restore(self, path: str | os.PathLike[str]) -> ControllerState:
        """The state that `save` wrote, bit for bit, in this process or another one.

        Args:
            path: of the file.

        Raises:
            InputError: no such file; one of another problem, solver or gate, or precision; numbers that are not finite.
        """
        return files.restore(self._first(self.problem.initial_policy(), None), path, self._owner)

    @functools.cached_property
    def _endless(self) -> PerformativeProblem | None:
        return endless(self.problem)

    @functools.cached_property
    def _owner(self) -> dict[str, str]:
        return {name: fingerprint(getattr(self, name)) for name in ("problem", "solver", "gate")}

    def _learnt(self, state: ControllerState) -> tuple[Any, Numbers, bool, str]:
        """Learner, deployed policy, whether it is a new one, and why."""
        before = state.learner
        if before.result != Result.running:
            return before, state.deployed, False, f"learning has ended. {Result[before.result]}"
        if int(before.steps) >= self.solver.steps:
            return before, state.deployed, False, f"all {self.solver.steps} steps are taken"
        after = learn(self.problem, self.solver, before, state.progress.episodes)
        if after.result != Result.running:
            text = f"no policy came of the step. {Result[after.result]}"
            return after if self.gate is None else taken_back(before, state.deployed), state.deployed, False, text
        if not bool(self.solver.schedule.deploys(jnp.asarray(after.own.count))):
            return after, state.deployed, False, "improved in the same world"
        reasons = self._refused(state, after)
        if reasons:
            return taken_back(before, state.deployed), state.deployed, False, "; ".join(reasons)
        return after, iterate(after), True, "a step of RSGD"

    def _refused(self, state: ControllerState, after: State) -> list[str]:
        """Why the gate does not let the newest policy pass."""
        if self.gate is None:
            return []
        if state.limits is None:
            raise fail(
                "state", "one begun without a gate", "carry what the gate goes by", "Begin with this controller's init."
            )
        size = float(size_of(self.solver.step_size, jnp.asarray(state.learner.own.count)))
        return self.gate.refuses(self.problem, self._endless, state.limits, iterate(after), state.deployed, size)

    def _read(self, name: str, value: Any, shape: tuple[int, ...], labels: tuple[str, ...]) -> Any:
        if not (isinstance(value, np.ndarray) and value.dtype == self._dtype and np.isfinite(value).all()):
            value = as_array(name, value).astype(self._dtype)
        check_shape(name, value, shape, labels)
        return value

    def _check_order(self, progress: Progress, x: np.ndarray) -> None:
        """Raise where the episode is over, or x_t is not where the last step has led."""
        T = self._finite.horizon
        if progress.t >= T:
            required = f"have seen fewer than the {T} of an episode"
            raise fail("state", f"{T} observed steps", required, "Call end_episode.")
        off = np.abs(x - progress.x).max()
        if progress.t > 0 and off > SLACK * max(np.abs(progress.x).max(), 1):
            remedy = "Observe every step once, in the order of time."
            raise fail("x", f"a state {off:.3g} away", "be the last x_next", remedy)
