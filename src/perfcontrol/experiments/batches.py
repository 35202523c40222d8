"""Batched compiled runs: stacked problems, many seeds, every host device busy, each program compiled once."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from perfcontrol.evaluate.exact import exact_cost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import RSGD, Result
from perfcontrol.solvers.base import State
from perfcontrol.solvers.runs import run_steps

LANES = 16  # runs worked on together on one device: they stay in cache
COST_LANES = 32  # policies likewise
COST_ROUNDS = 32  # times COST_LANES: policies a device costs in one compiled call
CHUNK = 100  # iterations in one compiled call
CEILING = 1e30  # costs of runaway policies are astronomical: recorded as this


def stack_problems(problems: list[PerformativeProblem]) -> PerformativeProblem:
    """Problems of equal structure as one, with a leading axis on every array."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *problems)


def in_single_precision(problem: PerformativeProblem) -> PerformativeProblem:
    """The problem with every floating-point array in float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, problem)


def pick(problems: PerformativeProblem, index: Array) -> PerformativeProblem:
    """One problem of a stack."""
    return jax.tree.map(lambda leaf: leaf[index] if eqx.is_array(leaf) else leaf, problems)


class StepRule(eqx.Module):
    """η_n = constant + phi1/(n + phi2): one compiled program for constant and diminishing steps."""

    constant: Any
    phi1: Any
    phi2: Any

    def __call__(self, n: Array) -> Array:
        return self.constant + self.phi1 / (n + self.phi2)


class Runs(NamedTuple):
    """RSGD runs given to a `Runner`, one a row: case (problem of the stack), stream of random numbers, start, step."""

    case: np.ndarray
    stream: np.ndarray
    start: np.ndarray
    rule: StepRule


class Ended(NamedTuple):
    """Some of the runs, ended. policies: (rows, steps+1, ...), the last one repeated where a run stopped early."""

    rows: np.ndarray
    policies: np.ndarray
    result: np.ndarray
    steps_taken: np.ndarray


class Runner:
    """RSGD on many runs of stacked problems, in compiled calls of `CHUNK` iterations on all devices.

    In single precision: its rounding is far below the sampling noise of the runs, and they take half the time.
    """

    def __init__(self, problems: PerformativeProblem, root: Array):
        self.problems = in_single_precision(problems)
        self.root = root
        mesh = Mesh(np.array(jax.devices()), ("rows",))
        self.block = LANES * mesh.size
        spec = PartitionSpec("rows")

        def mapped(function: Callable[..., Any], lanes: int = LANES) -> Callable[..., Any]:
            def local(arguments: Any) -> Any:
                return jax.lax.map(lambda one: function(*one), arguments, batch_size=lanes)

            return jax.jit(jax.shard_map(local, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))

        self._start = mapped(self._start_one)
        self._advance = mapped(self._advance_one)
        self._cost = mapped(lambda case, M: exact_cost(pick(self.problems, case), M, M), COST_LANES)
        self.costed = COST_LANES * COST_ROUNDS * mesh.size

    def _start_one(self, run: Any) -> State:
        return RSGD(CHUNK, run.rule).init(pick(self.problems, run.case), run.start)

    def _advance_one(self, run: Any, state: State, first: Array) -> tuple[State, Array]:
        key = jax.random.fold_in(self.root, run.stream)
        return run_steps(RSGD(CHUNK, run.rule), pick(self.problems, run.case), state, key, first, CHUNK)

    def run(self, runs: Runs, steps: int, progress: Callable[[float], None]) -> Iterator[Ended]:
        """Blocks of runs, each as soon as its `steps` iterations are done; a block of stopped runs costs no more."""
        count = len(runs.case)
        for first_row in range(0, count, self.block):
            rows = np.arange(first_row, min(first_row + self.block, count))
            block = jax.tree.map(lambda leaf, rows=rows: np.resize(leaf[rows], (self.block, *leaf.shape[1:])), runs)
            state = self._start((block,))
            policies = np.empty((self.block, steps + 1, *runs.start.shape[1:]), np.float32)
            policies[:, 0] = block.start
            for first in range(0, steps, CHUNK):
                if bool(np.all(_names(state) != "success")):
                    policies[:, first + 1 :] = policies[:, first : first + 1]
                    break
                state, visited = self._advance((block, state, np.full(self.block, first)))
                policies[:, first + 1 : first + CHUNK + 1] = np.asarray(visited)[:, : steps - first]
                progress((first_row + len(rows) * min(first + CHUNK, steps) / steps) / count)
            kept = slice(len(rows))
            yield Ended(rows, policies[kept], _names(state)[kept], np.asarray(state.steps)[kept])

    def costs(self, runs: Runs, ended: Ended) -> np.ndarray:
        """Exact C_T(M; M) of every policy of ended runs, (rows, steps+1), `CEILING` where it is larger or overflows.

        Policies past the step at which a run ended repeat its last one: their cost is not computed again.
        """
        rows, length = ended.policies.shape[:2]
        last = np.minimum(np.arange(length), ended.steps_taken[:, None])
        fresh = np.flatnonzero(np.arange(length) == last)
        policies = ended.policies.reshape(-1, *ended.policies.shape[2:])
        case = np.repeat(runs.case[ended.rows], length)
        values = np.empty(rows * length)
        for first in range(0, len(fresh), self.costed):
            part = fresh[first : first + self.costed]
            filled = np.resize(part, self.costed)  # the last part repeats itself: one compiled shape for all
            values[part] = np.asarray(self._cost((case[filled], policies[filled])))[: len(part)]
        spread = np.take_along_axis(values.reshape(rows, length), last, axis=1)
        return np.where(spread < CEILING, spread, CEILING)  # False for what is not finite


def _names(state: State) -> np.ndarray:
    """How each run of a batch stands; one that still runs has succeeded if it is not continued."""
    values = np.asarray(state.result._value)
    named = np.full(values.shape, "success", dtype="<U9")
    for name in ("diverged", "nonfinite"):
        named[values == np.asarray(getattr(Result, name)._value)] = name
    return named
