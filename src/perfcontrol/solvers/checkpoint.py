"""A run kept in a folder: killed at any moment, the same call goes on where it was saved last, bit for bit.

    lock             held by the process that works in the folder
    run.json         what is run: fingerprints of its parts, the number of steps, versions
    state.npz        what the solver carried when the run was saved last, and how much of the history counts
    history.npy      what was recorded, row after row (history.0.npy, ... where a record has several arrays)
    solution.npz     once the run has ended: its answer
    rescue/          the same for the method that the run went on with, if any

A border is saved history first, state second. The state replaces the one before it in a single step of the file
system, so what it counts on is there, and rows beyond that belong to nobody and are written again.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from perfcontrol._array_files import filled
from perfcontrol.solvers.base import Solution, State
from perfcontrol.solvers.history import Held, Streamed
from perfcontrol.solvers.result import MEMBERS, name_of
from perfcontrol.solvers.run_folder import RunFolder, held

PAUSE = 20  # saving takes at most one part in so many of the time
FIRST = 0.05  # seconds that saving is taken to cost before it was measured
STATE, SOLUTION = "state.npz", "solution.npz"


class Forgotten:
    """A run that leaves nothing behind."""

    def __init__(self) -> None:
        self.history: Held | Streamed = Held()

    def begin(self, blank: State) -> tuple[State, int]:
        """The state to go on from, and the steps done; `blank` is the one before the first step."""
        return blank, 0

    def border(self, state: State, done: int, last: bool) -> None:
        """The run stands here, and may be stopped; `last`: it has ended."""

    def below(self, name: str, parts: dict[str, Any], record: Any) -> "Forgotten":
        """For a run that is part of this one."""
        return Forgotten()

    def end(self, solution: Solution) -> None:
        """What the run, its parts included, has ended with."""


class Kept(Forgotten):
    """A run in a folder that this process holds.

    Args:
        path: where.
        parts: what is run.
        record: what `record` gives of a policy, or its shapes.
    """

    def __init__(self, path: Path, parts: dict[str, Any], record: Any):
        self._folder = RunFolder(path, parts)
        self._folder.sweep(STATE, SOLUTION)
        self.history = self._streamed = Streamed(path, record, parts["steps"] // parts["every"] + 1)
        self._saved, self._cost = time.monotonic(), FIRST

    def below(self, name: str, parts: dict[str, Any], record: Any) -> "Kept":
        return Kept(self._folder.path / name, parts, record)

    def begin(self, blank: State) -> tuple[State, int]:
        read = self._folder.read(STATE)
        if read is None:
            self._streamed.begin()
            return blank, 0
        self._folder.check_versions()
        header, arrays = read
        with self._folder.readable(STATE):
            state = filled(blank, arrays)
            self._streamed.resume([(rows, check) for rows, check in header["history"]])
            # Known results are the members themselves.
            return state._replace(result=MEMBERS[name_of(state.result)]), header["done"]

    def border(self, state: State, done: int, last: bool) -> None:
        began = time.monotonic()
        if last or began - self._saved >= PAUSE * self._cost:
            self._folder.write(STATE, state, done=done, history=self._streamed.flush())
            self._saved = time.monotonic()
            self._cost = self._saved - began

    def solution(self) -> Solution | None:
        """What an earlier call has ended with."""
        read = self._folder.read(SOLUTION)
        if read is None:
            return None
        header, arrays = read
        with self._folder.readable(SOLUTION):
            stats = {name: arrays[f"stats.{name}"] for name in header["stats"]}
            answer = arrays["M"], MEMBERS[header["result"]], arrays["steps"], stats
            self._streamed.ended()
            M, result, steps, stats = jax.tree.map(jnp.asarray, answer)
            return Solution(M, result, steps, self.history.all(), stats)

    def end(self, solution: Solution) -> None:
        self._streamed.flush()
        arrays = {"M": solution.M, "steps": solution.steps, "stats": solution.stats}
        self._folder.write(SOLUTION, arrays, result=name_of(solution.result), stats=list(solution.stats))


@contextmanager
def kept(folder: Any, parts: dict[str, Any], record: Any) -> Iterator[Kept]:
    """Hold a folder for a run."""
    with held(folder) as path:
        yield Kept(path, parts, record)
