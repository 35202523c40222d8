"""The loop that every solver runs in: `init`, `step`, `finish`, in compiled chunks, with a record kept inside."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import check_integer, check_key, fail, is_concrete
from perfcontrol._programs import Numbers, numerics, on_host, program
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.result import Result

CHUNK = 500  # iterations compiled together: long enough to cost nothing, short enough to stop early

Record = Callable[[Array], Any]


class SolveError(RuntimeError):
    """A run that did not end well, raised by `solve(throw=True)`.

    Attributes:
        solution: the `Solution`, with what was reached.
    """

    def __init__(self, message: str, solution: "Solution"):
        super().__init__(message)
        self.solution = solution


class State(eqx.Module):
    """What every solver carries: the iterate, the number of steps taken, how the run stands, the solver's own."""

    M: Numbers
    steps: Numbers
    result: Result
    own: Any


class AbstractSolver(eqx.Module):
    """A method with frozen settings."""

    @property
    @abc.abstractmethod
    def max_steps(self) -> int:
        """Steps that `solve` runs at most unless told otherwise."""

    @property
    def needs_key(self) -> bool:
        """Whether steps draw random numbers."""
        return False

    @property
    def from_host(self) -> bool:
        """Whether steps do their heavy work in programs of their own, so that the loop need not be compiled."""
        return False

    @abc.abstractmethod
    def check(self, problem: PerformativeProblem) -> None:
        """Raise InputError where this method does not apply to the problem."""

    @abc.abstractmethod
    def init(self, problem: PerformativeProblem, M0: Any) -> State:
        """The state before the first step."""

    @abc.abstractmethod
    def step(self, problem: PerformativeProblem, state: State, key: Any) -> State:
        """One iteration; `key` is that iteration's own."""

    @abc.abstractmethod
    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Any]]:
        """Result and statistics of the last state; `stopped` says that max_steps of `solve` cut the run short."""


class Solution(eqx.Module):
    """What `solve` returns.

    Attributes:
        M: the policy (free parameters), finite always.
        result: a `Result`.
        steps: iterations taken; where the run failed, the iteration at which it did.
        history: `record` at steps 0, every, 2·every, ... (leading axis), the last value repeated once a run has ended.
        stats: method-specific numbers, such as `unique` and `residual`.
    """

    M: Array
    result: Result
    steps: Array
    history: Any
    stats: dict[str, Array]


def start(M0: Any, own: Any = None) -> State:
    """The first state."""
    xp, _ = numerics(M0)
    return State(M0, xp.zeros((), int), Result.running, own)


def _run(
    solver: AbstractSolver,
    problem: PerformativeProblem,
    state: State,
    key: Array | None,
    first: Array | int,
    count: int,
    record: Record,
    every: int,
) -> tuple[State, Any]:
    """`count` iterations, a multiple of `every`, recorded after each `every`; ended runs stay as they are."""

    def iterate(state: State, n: Array) -> State:
        step_key = None if key is None else jax.random.fold_in(key, n)
        return jax.lax.cond(
            state.result == Result.running, lambda s: solver.step(problem, s, step_key), lambda s: s, state
        )

    def block(state: State, index: Array) -> tuple[State, Any]:
        if every == 1:
            state = iterate(state, first + index)
        else:
            state = jax.lax.fori_loop(0, every, lambda j, s: iterate(s, first + index * every + j), state)
        return state, record(state.M)

    return jax.lax.scan(block, state, jnp.arange(count // every))


def run_steps(
    solver: AbstractSolver, problem: PerformativeProblem, state: State, key: Array | None, first: Array, count: int
) -> tuple[State, Array]:
    """`count` iterations from iteration `first` on, and the iterate after each; pure, for batched runs of one's own."""
    return _run(solver, problem, state, key, first, count, _identity, 1)


_compiled_run = program(_run, on_device=True)
_compiled_record = program(lambda record, M: record(M))
_compiled_init = program(lambda solver, problem, M0: solver.init(problem, M0), on_device=True)


def _identity(M: Any) -> Any:
    return M


def solve(
    problem: PerformativeProblem,
    solver: AbstractSolver,
    M0: Any = None,
    *,
    key: Any = None,
    max_steps: int | None = None,
    record: Record | None = None,
    every: int = 1,
    throw: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Solution:
    """Run a solver on a problem.

    Iteration n draws its randomness from `fold_in(key, n)`, so the same key gives the same run, whatever the chunks.
    Works under jit and vmap (over keys, starts or stacked problems); then nothing is raised.

    Args:
        problem: the problem.
        solver: `RSGD`, `RRM`, `StablePoint`, ...
        M0: feasible start, free parameters; None: the feasible policy nearest to zero.
        key: JAX random key; required by solvers that sample.
        max_steps: overrides the solver's own number of steps.
        record: M -> any pytree of arrays, run inside the compiled loop and kept as `history`; default M itself.
        every: record every so many steps.
        throw: raise SolveError unless the result is `success`.
        progress: called on the host with (steps done, steps at most) after each compiled chunk.

    Raises:
        InputError: arguments that do not fit, before any work.
        SolveError: the run failed and `throw` is True; its `.solution` is what was reached.
    """
    if not isinstance(problem, PerformativeProblem):
        raise fail("problem", type(problem).__name__, "be a PerformativeProblem", "Build it first.")
    if not isinstance(solver, AbstractSolver):
        raise fail("solver", type(solver).__name__, "be a solver", "Pass for example pc.StablePoint().")
    solver.check(problem)
    key = check_key(key) if solver.needs_key or key is not None else None
    every = check_integer("every", every, 1)
    total = solver.max_steps if max_steps is None else check_integer("max_steps", max_steps, 0)
    M0 = problem.initial_policy() if M0 is None else problem.check_policy("M0", M0)
    leaves = jax.tree.leaves(eqx.filter((problem, solver, M0, key), eqx.is_array))
    concrete = all(is_concrete(leaf) for leaf in leaves)
    if concrete and not bool(problem.feasible_set.contains(M0, _slack(M0))):
        raise fail(
            "M0",
            f"a policy {float(jnp.linalg.norm(M0 - problem.feasible_set.project(M0))):.3g} away",
            "lie in the feasible set",
            "Pass problem.feasible_set.project(M0), or leave M0 out.",
        )
    record = _identity if record is None else record
    stopped = max_steps is not None and max_steps < solver.max_steps
    if not concrete:
        return _traced(problem, solver, M0, key, total, record, every, stopped)
    run = _from_host if solver.from_host else _in_chunks
    with np.errstate(all="ignore"):  # numbers that are not finite become a named result
        state, history = run(problem, solver, M0, key, total, record, every, progress)
        state = on_host(state)
        result, stats = solver.finish(problem, state, stopped)
    answer = jax.tree.map(jnp.asarray, (state.M, result, state.steps, _joined(history), stats))
    solution = Solution(*answer)
    if throw and result != Result.success:
        raise SolveError(f"{Result[result]} (step {int(state.steps)})", solution)
    return solution


def _slack(M: Array) -> float:
    return 1e-8 if M.dtype == jnp.float64 else 1e-4


def _traced(
    problem: PerformativeProblem,
    solver: AbstractSolver,
    M0: Array,
    key: Array | None,
    total: int,
    record: Record,
    every: int,
    stopped: bool,
) -> Solution:
    state = solver.init(problem, M0)
    history = [jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], record(M0))]
    whole = total - total % every
    state, recorded = _run(solver, problem, state, key, 0, whole, record, every)
    history.append(recorded)
    if total % every:
        state, _ = _run(solver, problem, state, key, whole, total % every, lambda M: jnp.zeros(()), 1)
    result, stats = solver.finish(problem, state, stopped)
    return Solution(state.M, result, state.steps, _joined(history), stats)


Progress = Callable[[int, int], None] | None


def _in_chunks(
    problem: PerformativeProblem,
    solver: AbstractSolver,
    M0: Array,
    key: Array | None,
    total: int,
    record: Record,
    every: int,
    progress: Progress,
) -> tuple[State, list[Any]]:
    """The run in compiled chunks, and its history in pieces."""
    state = _compiled_init(solver, problem, M0)
    history = [_first(record, M0)]
    chunk = max(every, CHUNK - CHUNK % every)
    done = 0
    while done < total:
        count = min(chunk, total - done)
        whole = count - count % every
        first = np.asarray(done)
        if whole:
            state, recorded = _compiled_run(solver, problem, state, key, first, whole, record, every)
            history.append(recorded)
        if count - whole:
            state, _ = _compiled_run(solver, problem, state, key, first + whole, count - whole, _nothing, 1)
        done += count
        if progress is not None:
            progress(done, total)
        if state.result != Result.running:
            break
    if done % every == 0:
        history.append(_repeated(history[-1], (total - done) // every))
    return state, history


def _from_host(
    problem: PerformativeProblem,
    solver: AbstractSolver,
    M0: Array,
    key: Array | None,
    total: int,
    record: Record,
    every: int,
    progress: Progress,
) -> tuple[State, list[Any]]:
    """The run step by step: the solver's own programs do the work."""
    state = solver.init(problem, on_host(M0))
    history = [_first(record, M0)]
    for done in range(1, total + 1):
        state = solver.step(problem, state, None if key is None else jax.random.fold_in(key, done - 1))
        if done % every == 0:
            history.append(_first(record, state.M))
        if progress is not None:
            progress(done, total)
        if state.result is not Result.running:  # known results are the members themselves
            break
    return state, [*history, _repeated(history[-1], total // every + 1 - len(history))]


def _first(record: Record, M: Any) -> Any:
    value = on_host(M) if record is _identity else _compiled_record(record, M)
    return jax.tree.map(lambda leaf: leaf[None], value)


def _repeated(recorded: Any, count: int) -> Any:
    """What a run that ended early lacks to be as long as under jit."""
    return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[-1:], count, axis=0), recorded)


def _nothing(M: Any) -> Array:
    return jnp.zeros(())


def _joined(history: list[Any]) -> Any:
    xp, _ = numerics(history)
    return jax.tree.map(lambda *leaves: xp.concatenate(leaves), *history)
