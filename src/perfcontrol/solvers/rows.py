"""Many runs as rows: which problem, solver, key and start each has, and a program over rows on all devices.

Rows are dealt out to this process's devices by `jax.shard_map`; each device works on a few `lanes` of them at a time,
so that what they draw stays in its cache, and on one group of lanes after the other.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from perfcontrol._programs import known, program
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_keys import rearranged
from perfcontrol.solvers.base import AbstractSolver, State
from perfcontrol.solvers.result import Result
from perfcontrol.solvers.runs import Record, record_of, run_steps


class Shared(NamedTuple):
    """What rows choose from: stacked problems and solvers."""

    problems: PerformativeProblem
    solvers: AbstractSolver


class Rows(NamedTuple):
    """One run a row, held on the host.

    start: None for the feasible policy nearest to zero; key: None where nothing is drawn.
    """

    problem: Any
    solver: Any
    key: Any
    start: Any

    def take(self, index: Any) -> "Rows":
        """Some of the rows, or one."""
        arrays = jax.tree.map(lambda leaf: leaf[index], self._replace(key=None))
        return arrays._replace(key=None if self.key is None else rearranged(self.key, lambda words: words[index]))

    def dealt(self) -> "Rows":
        """The rows on the devices that work on them."""
        return jax.device_put(self, NamedSharding(*_over_devices()))


def pick(stack: Any, index: Any) -> Any:
    """One member of a stack, or the stack of several."""

    def picked(leaf: Any) -> Any:
        # What is known is picked on the host: JAX would compile a program for each shape.
        return jax.device_put(np.asarray(leaf)[index]) if known(leaf, index) else leaf[index]

    return jax.tree.map(lambda leaf: picked(leaf) if eqx.is_array(leaf) else leaf, stack)


def on_devices(function: Callable[..., Any], lanes: int, shared: Any, rows: Any) -> Any:
    """`function(shared, row)` of every row; their number is a multiple of `lanes` on every device."""
    return groups_on_devices(lambda shared, group: in_lanes(function, shared, group), lanes, shared, rows)


def in_lanes(function: Callable[..., Any], shared: Any, group: Any) -> Any:
    """`function(shared, row)` of the rows of a group; one row alone keeps its branches."""
    if len(jax.tree.leaves(group)[0]) > 1:
        return jax.vmap(lambda row: function(shared, row))(group)
    ended = function(shared, jax.tree.map(lambda leaf: leaf[0], group))
    return jax.tree.map(lambda leaf: leaf[None], ended)


def groups_on_devices(function: Callable[..., Any], lanes: int, shared: Any, rows: Any) -> Any:
    """`function(shared, group)` of every `lanes` rows."""
    arrays, others = eqx.partition(shared, eqx.is_array)

    def local(arrays: Any, rows: Any) -> Any:
        groups = jax.tree.map(lambda leaf: leaf.reshape(-1, lanes, *leaf.shape[1:]), rows)
        ended = jax.lax.map(lambda group: function(eqx.combine(arrays, others), group), groups)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), ended)

    mesh, split = _over_devices()
    specs = (PartitionSpec(), split)
    return jax.shard_map(local, mesh=mesh, in_specs=specs, out_specs=split, check_vma=False)(arrays, rows)


def _over_devices() -> tuple[Mesh, PartitionSpec]:
    """The devices of this process, and rows dealt out to them."""
    return Mesh(np.array(jax.local_devices()), ("rows",)), PartitionSpec("rows")


def _parts(shared: Shared, row: Rows) -> tuple[PerformativeProblem, AbstractSolver, Array]:
    problem = pick(shared.problems, row.problem)
    solver = pick(shared.solvers, row.solver).on(problem, row.key)
    return problem, solver, problem.initial_policy() if row.start is None else row.start


@program(on_device=True)
def begin(lanes: int, record: Record | None, shared: Shared, rows: Rows) -> tuple[State, Any]:
    """States before the first step, and records, with an axis of length 1, of the starts."""

    def one(shared: Shared, row: Rows) -> tuple[State, Any]:
        problem, solver, M0 = _parts(shared, row)
        kept = None if record is None else jax.tree.map(lambda leaf: leaf[None], record_of(record, M0))
        return solver.init(problem, M0), kept

    return on_devices(one, lanes, shared, rows)


def _advance(
    lanes: int, record: Record | None, every: int, count: int, shared: Shared, rows: Rows, state: State, first: Array
) -> tuple[State, Any]:
    """`count` iterations of every row from iteration `first` on, recorded after each `every`."""
    kept = (lambda M: None) if record is None else record

    def going(shared: tuple[Shared, Array], work: tuple[Rows, State]) -> tuple[State, Any]:
        row, state = work
        problem, solver, _ = _parts(shared[0], row)
        return run_steps(solver, problem, state, row.key, shared[1], count, kept, every)

    def ended(shared: Any, work: tuple[Rows, State]) -> tuple[State, Any]:
        last = record_of(kept, work[1].M)
        return work[1], jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count // every, *leaf.shape)), last)

    def group(shared: tuple[Shared, Array], work: tuple[Rows, State]) -> tuple[State, Any]:
        runs = jnp.any(work[1].result == Result.running)  # asked of the group: single lanes would take both branches
        return jax.lax.cond(runs, lambda: in_lanes(going, shared, work), lambda: in_lanes(ended, shared, work))

    return groups_on_devices(group, lanes, (shared, first), (rows, state))


advance = program(_advance, on_device=True)
advance_wide = program(_advance, on_device=True, quick=False, whole=False)


@program(on_device=True)
def finish(lanes: int, stopped: bool, shared: Shared, rows: Rows, state: State) -> dict[str, Any]:
    """What every row ended with."""

    def one(shared: Shared, work: tuple[Rows, State]) -> dict[str, Any]:
        row, state = work
        problem, solver, _ = _parts(shared, row)
        result, stats = solver.finish(problem, state, stopped)
        return {"M": state.M, "result": result, "steps": state.steps, "stats": stats}

    return on_devices(one, lanes, shared, (rows, state))
