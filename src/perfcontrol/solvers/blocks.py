"""Rows in blocks of one shape: run, kept in a folder, read again."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from perfcontrol._array_files import filled
from perfcontrol.evaluate.paths import LANES, lanes
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.base import AbstractSolver
from perfcontrol.solvers.result import Result, where
from perfcontrol.solvers.rows import Rows, Shared, advance, advance_wide, begin, finish
from perfcontrol.solvers.run_folder import RunFolder
from perfcontrol.solvers.runs import Record

CHUNK = 100  # iterations compiled together
ROUNDS = 4  # groups of lanes that a device works through in one compiled call
WIDE = 16  # lanes from which on the compiler makes vectors of all that lies side by side, in multiples of these


class Work(NamedTuple):
    """What is done with rows: `total` steps, recorded after each `every`; `lanes` rows together on each device."""

    shared: Shared
    record: Record | None
    every: int
    total: int
    stopped: bool
    lanes: int

    def run(self, rows: Rows, show: Callable[[int], None]) -> dict[str, Any]:
        """What every row has ended with, on the host; `show` is called with the iterations done."""
        rows = rows.dealt()
        state, kept = begin(self.lanes, self.record, self.shared, rows)
        history: list[Any] = []
        chunk, done = max(self.every, CHUNK - CHUNK % self.every), 0
        unfinished = True
        while done < self.total and unfinished:
            before = state.result
            count = min(chunk, self.total - done)
            rest = count % self.every
            if count > rest:
                state, following = self._advanced(rows, state, done, count - rest, self.record, self.every)
                history.append(_on_host(kept))  # while the devices go on
                kept = following
            if rest:
                state, _ = self._advanced(rows, state, done + count - rest, rest, None, 1)
            # Asked of the chunk before this one, so that the devices need not wait for the answer: where all had ended
            # by then, this one changes nothing.
            unfinished = bool(np.any(where(before, Result.running)))
            done += count
            if done < self.total:
                show(done)
        history.append(_on_host(kept))
        ended = finish(self.lanes, self.stopped, self.shared, rows, state)
        length = self.total // self.every + 1
        return _on_host(ended) | {"history": jax.tree.map(lambda *parts: _whole(parts, length), *history)}

    def _advanced(self, rows: Rows, state: Any, first: int, count: int, record: Record | None, every: int) -> Any:
        program = advance if self.shared.solvers.lanes is None else advance_wide
        return program(self.lanes, record, every, count, self.shared, rows, state, np.asarray(first))

    def blank(self, rows: Rows) -> dict[str, Any]:
        """What `run` returns for these rows, in shapes alone."""

        def ended(shared: Shared, rows: Rows) -> dict[str, Any]:
            state, kept = begin(self.lanes, self.record, shared, rows)
            return finish(self.lanes, self.stopped, shared, rows, state) | {"history": kept}

        shapes = eqx.filter_eval_shape(ended, self.shared, rows)
        length = self.total // self.every + 1
        lengthened = jax.tree.map(lambda s: np.empty((s.shape[0], length, *s.shape[2:]), s.dtype), shapes["history"])
        arrays = jax.tree.map(lambda s: np.empty(s.shape, s.dtype), {k: v for k, v in shapes.items() if k != "history"})
        return arrays | {"history": lengthened}


def lanes_of(problem: PerformativeProblem, solver: AbstractSolver, count: int) -> int:
    """How many of `count` runs a device works on together; one where steps branch: lanes would take every branch."""
    share = math.ceil(count / len(jax.local_devices()))
    if solver.lanes is not None:
        return min(solver.lanes, WIDE * math.ceil(share / WIDE))
    together = 1 if solver.from_host else lanes(problem, solver.draws_along) if problem.is_finite else LANES
    return max(1, min(together, share))


def blocks_of(count: int, together: int) -> list[np.ndarray]:
    """Places 0..count-1 in blocks of one size, a multiple of what devices work on together; the last repeats some."""
    group = together * len(jax.local_devices())
    number = math.ceil(count / (group * ROUNDS))
    size = group * math.ceil(count / (group * number))
    return [np.resize(np.arange(first, min(first + size, count)), size) for first in range(0, count, size)]


def run_blocks(
    work: Work, rows: Rows, place: np.ndarray, folder: RunFolder | None, progress: Callable[[int, int], None] | None
) -> Any:
    """What the rows have ended with, by their order; `place` is where they stand among those of all processes."""
    count, ended = len(place), []
    for block in blocks_of(count, work.lanes):
        size = len(np.unique(block))

        def show(done: int, before: int = int(block[0]), size: int = size) -> None:
            if progress is not None:
                progress(before * work.total + size * done, count * work.total)

        name = f"runs-{place[block[0]]}-{place[block[size - 1]]}.npz"
        picked = rows.take(place[block])
        answer = None if folder is None else _read(folder, name, lambda picked=picked: work.blank(picked), size)
        if answer is None:
            answer = jax.tree.map(lambda leaf, size=size: leaf[:size], work.run(picked, show))
            if folder is not None:
                folder.write(name, answer)
        show(work.total)
        ended.append(answer)
    return ended[0] if len(ended) == 1 else jax.tree.map(lambda *parts: np.concatenate(parts), *ended)


def _read(folder: RunFolder, name: str, blank: Callable[[], Any], size: int) -> Any:
    """A block that an earlier call has finished; None where it has not."""
    read = folder.read(name)
    if read is None:
        folder.sweep(name)
        return None
    with folder.readable(name):
        return filled(jax.tree.map(lambda leaf: leaf[:size], blank()), read[1])


def _whole(parts: tuple[np.ndarray, ...], length: int) -> np.ndarray:
    """Records along their axis, the last one repeated where all runs ended early."""
    joined = np.concatenate(parts, axis=1)
    missing = length - joined.shape[1]
    return np.concatenate([joined, np.repeat(joined[:, -1:], missing, axis=1)], axis=1) if missing else joined


def _on_host(tree: Any) -> Any:
    return jax.tree.map(np.asarray, tree)
