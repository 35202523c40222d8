"""The loop that every solver runs in: `init`, `step`, `finish`, in compiled chunks, with a record kept inside."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from perfcontrol._checks import check_integer, check_key, fail, is_concrete
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.result import Result

CHUNK = 500  # iterations compiled together: long enough to cost nothing, short enough to stop early

Record = Callable[[Array], Any]


class SolveError(RuntimeError):
    """A run that did not end well, raised by `solve(throw=True)`; `.solution` holds what was reached."""

    def __init__(self, message: str, solution: "Solution"):
        super().__init__(message)
        self.solution = solution


class State(eqx.Module):
    """What every solver carries: the iterate, the number of steps taken, how the run stands, the solver's own."""

    M: Array
    steps: Int[Array, ""]
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

    @abc.abstractmethod
    def check(self, problem: PerformativeProblem) -> None:
        """Raise InputError where this method does not apply to the problem."""

    @abc.abstractmethod
    def init(self, problem: PerformativeProblem, M0: Array) -> State:
        """The state before the first step."""

    @abc.abstractmethod
    def step(self, problem: PerformativeProblem, state: State, key: Array | None) -> State:
        """One iteration; `key` is that iteration's own."""

    @abc.abstractmethod
    def finish(self, problem: PerformativeProblem, state: State, stopped: bool) -> tuple[Result, dict[str, Array]]:
        """Result and statistics of the last state; `stopped` says that max_steps of `solve` cut the run short."""


class Solution(eqx.Module):
    """What `solve` returns.

    M: the policy (free parameters), finite always. result: a `Result`. steps: iterations taken; where the run
    failed, the iteration at which it did. history: `record` at steps 0, every, 2·every, ... (leading axis), the
    last value repeated once a run has ended. stats: method-specific numbers, such as `unique` and `residual`.
    """

    M: Array
    result: Result
    steps: Array
    history: Any
    stats: dict[str, Array]


def start(M0: Array, own: Any = None) -> State:
    """The first state."""
    return State(M0, jnp.zeros((), int), Result.running, own)


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


_compiled_run = eqx.filter_jit(_run)
_compiled_record = eqx.filter_jit(lambda record, M: record(M))
_compiled_init = eqx.filter_jit(lambda solver, problem, M0: solver.init(problem, M0))
_compiled_finish = eqx.filter_jit(lambda solver, problem, state, stopped: solver.finish(problem, state, stopped))


def _identity(M: Array) -> Array:
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
        solution = _traced(problem, solver, M0, key, total, record, every, stopped)
    else:
        solution = _on_host(problem, solver, M0, key, total, record, every, stopped, progress)
        if throw and solution.result != Result.success:
            raise SolveError(f"{Result[solution.result]} (step {int(solution.steps)})", solution)
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


def _on_host(
    problem: PerformativeProblem,
    solver: AbstractSolver,
    M0: Array,
    key: Array | None,
    total: int,
    record: Record,
    every: int,
    stopped: bool,
    progress: Callable[[int, int], None] | None,
) -> Solution:
    state = _compiled_init(solver, problem, M0)
    history = [jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], _compiled_record(record, M0))]
    chunk = max(every, CHUNK - CHUNK % every)
    done = 0
    while done < total:
        count = min(chunk, total - done)
        whole = count - count % every
        first = jnp.asarray(done)
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
    result, stats = _compiled_finish(solver, problem, state, stopped)
    missing = (total - done) // every if done % every == 0 else 0
    if missing:  # ended early: as long as under jit, the last value repeated
        history.append(jax.tree.map(lambda leaf: jnp.repeat(leaf[-1:], missing, axis=0), history[-1]))
    return Solution(state.M, result, state.steps, _joined(history), stats)


def _nothing(M: Array) -> Array:
    return jnp.zeros(())


def _joined(history: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *history)
