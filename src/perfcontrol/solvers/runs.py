"""How a run goes: traced whole, in compiled chunks, or step by step from the host; recorded alike each way."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._functions import call
from perfcontrol._programs import on_host, program
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.base import AbstractSolver, State
from perfcontrol.solvers.checkpoint import Forgotten
from perfcontrol.solvers.history import joined
from perfcontrol.solvers.result import Result

CHUNK = 500  # iterations compiled together: long enough to cost nothing, short enough to stop early

Record = Callable[[Array], Any]


def record_of(record: Record, M: Any) -> Any:
    """What a user's `record` gives at a policy, as arrays."""
    return call("record", lambda M: jax.tree.map(jnp.asarray, record(M)), free_parameters=M)


def identity(M: Any) -> Any:
    """The record that keeps the policy itself."""
    return M


class Run(NamedTuple):
    """What is to be run: `total` iterations from M0, `record` of the policy kept after each `every`."""

    problem: PerformativeProblem
    solver: AbstractSolver
    M0: Any
    key: Array | None
    total: int
    record: Record = identity
    every: int = 1
    progress: Callable[[int, int], None] | None = None


def described(run: Run) -> tuple[dict[str, Any], Any]:
    """What tells this run from others, by name, and the shapes of a record."""
    parts = {
        "problem": run.problem,
        "solver": run.solver,
        "start": run.M0,
        "key": run.key,
        "record": run.record,
        "every": run.every,
        "steps": run.total,
    }
    return parts, jax.eval_shape(lambda M: record_of(run.record, M), run.M0)


def run_steps(
    solver: AbstractSolver,
    problem: PerformativeProblem,
    state: State,
    key: Array | None,
    first: Array | int,
    count: int,
    record: Record,
    every: int,
) -> tuple[State, Any]:
    """`count` iterations from iteration `first` on, recorded after each `every`; pure. Ended runs stay as they are."""

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
        return state, record_of(record, state.M)

    return jax.lax.scan(block, state, jnp.arange(count // every))


_compiled_run = program(run_steps, on_device=True)
_compiled_record = program(record_of)
_compiled_init = program(lambda solver, problem, M0: solver.init(problem, M0), on_device=True)


def traced(run: Run) -> tuple[State, Any]:
    """The whole run inside somebody else's trace."""
    problem, solver, M0, key, total, record, every, _ = run
    state = solver.init(problem, M0)
    history = [jax.tree.map(lambda leaf: leaf[None], record_of(record, M0))]
    whole = total - total % every
    state, kept = run_steps(solver, problem, state, key, 0, whole, record, every)
    history.append(kept)
    if total % every:
        state, _ = run_steps(solver, problem, state, key, whole, total % every, _nothing, 1)
    return state, joined(history)


def in_chunks(run: Run, keeping: Forgotten) -> State:
    """The run in compiled chunks, recorded in the history of `keeping`."""
    problem, solver, M0, key, total, record, every, progress = run
    history = keeping.history
    state, done = keeping.begin(_compiled_init(solver, problem, M0))
    if not history.rows:
        history.add(_recorded(record, M0))
    chunk = max(every, CHUNK - CHUNK % every)
    while done < total and state.result == Result.running:
        count = min(chunk, total - done)
        whole = count - count % every
        first = np.asarray(done)
        if whole:
            state, rows = _compiled_run(solver, problem, state, key, first, whole, record, every)
            history.add(rows)
        if count - whole:
            state, _ = _compiled_run(solver, problem, state, key, first + whole, count - whole, _nothing, 1)
        done += count
        keeping.border(state, done, last=done == total or bool(state.result != Result.running))
        if progress is not None:
            progress(done, total)
    history.repeat(total // every + 1 - history.rows)
    return state


def from_host(run: Run, keeping: Forgotten) -> State:
    """The run step by step: the solver's own programs do the work."""
    problem, solver, M0, key, total, record, every, progress = run
    history = keeping.history
    state, done = keeping.begin(solver.init(problem, on_host(M0)))
    if not history.rows:
        history.add(_recorded(record, M0))
    opened = solver.opening(problem, state, total) if done == 0 < total else None
    while done < total and state.result is Result.running:  # known results are the members themselves
        if done == 0 and opened is not None:
            state, policies = opened
        else:
            state = solver.step(problem, state, None if key is None else jax.random.fold_in(key, done))
            policies = [state.M]
        ended = state.result is not Result.running
        for M in policies:
            done += 1
            # What is repeated is where the run ended, be it between two records.
            if done % every == 0 or (ended and M is policies[-1] and history.rows <= total // every):
                history.add(_recorded(record, M))
        keeping.border(state, done, last=done == total or ended)
        if progress is not None:
            progress(done, total)
    history.repeat(total // every + 1 - history.rows)
    return state


def _recorded(record: Record, M: Any) -> Any:
    value = on_host(M) if record is identity else _compiled_record(record, M)
    return jax.tree.map(lambda leaf: leaf[None], value)


def _nothing(M: Any) -> Array:
    return jnp.zeros(())
