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

import dataclasses
import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._array_files import UnreadableError, filled, read_arrays, write_arrays
from perfcontrol._checks import InputError, fail
from perfcontrol._files import leftovers, naming, written_whole
from perfcontrol._fingerprint import fingerprint
from perfcontrol._lock import NAME as LOCK
from perfcontrol._lock import locked
from perfcontrol.solvers.base import Solution, State
from perfcontrol.solvers.history import Held, Streamed
from perfcontrol.solvers.result import MEMBERS, name_of

FORMAT = "perfcontrol run 1"
PAUSE = 20  # saving takes at most one part in so many of the time
FIRST = 0.05  # seconds that saving is taken to cost before it was measured
RUN, STATE, SOLUTION = "run.json", "state.npz", "solution.npz"


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
        folder: where.
        parts: what is run, and by it whether the folder is of this run.
        record: what `record` gives of a policy, or its shapes.
    """

    def __init__(self, folder: Path, parts: dict[str, Any], record: Any):
        self.folder = folder
        self.history = self._streamed = Streamed(folder, record, parts["steps"] // parts["every"] + 1)
        self._saved, self._cost = time.monotonic(), FIRST
        self._told = {name: part if isinstance(part, int) else fingerprint(part) for name, part in parts.items()}
        self._run = fingerprint(self._told)
        with naming(folder):
            folder.mkdir(exist_ok=True)
        for name in (RUN, STATE, SOLUTION):
            for leftover in leftovers(folder / name):
                leftover.unlink()
        if not (folder / RUN).exists():
            content = {"format": FORMAT, **self._told, "versions": _versions()}
            with written_whole(folder / RUN) as temporary:
                temporary.write_text(json.dumps(content, indent=1))
        self._check_run()

    def below(self, name: str, parts: dict[str, Any], record: Any) -> "Kept":
        return Kept(self.folder / name, parts, record)

    def _check_run(self) -> None:
        path = self.folder / RUN
        try:
            content = json.loads(path.read_text())
            if not isinstance(content, dict) or content.get("format") != FORMAT:
                raise ValueError(FORMAT)
        except ValueError as error:
            raise self._unreadable(f"{RUN} with other content") from error
        for name, value in self._told.items():
            if content.get(name) != value:
                required = f"hold a run of the same {name}"
                raise fail("checkpoint", f"{self.folder}, of another {name}", required, "Pass another folder.")
        self._made_with = content.get("versions")

    def begin(self, blank: State) -> tuple[State, int]:
        read = self._read(STATE)
        if read is None:
            self._streamed.begin()
            return blank, 0
        if self._made_with != _versions():
            required = f"be of a run begun with the versions that go on with it, {_listed(_versions())}"
            got = f"{self.folder}, begun with {_listed(self._made_with)}"
            raise fail("checkpoint", got, required, "Use those versions again, or begin in another folder.")
        header, arrays = read
        with self._readable(STATE):
            state = filled(blank, arrays)
            self._streamed.resume([(rows, check) for rows, check in header["history"]])
            # Known results are the members themselves.
            return dataclasses.replace(state, result=MEMBERS[name_of(state.result)]), header["done"]

    def border(self, state: State, done: int, last: bool) -> None:
        began = time.monotonic()
        if last or began - self._saved >= PAUSE * self._cost:
            self._write(STATE, state, done=done)
            self._saved = time.monotonic()
            self._cost = self._saved - began

    def solution(self) -> Solution | None:
        """What an earlier call has ended with."""
        read = self._read(SOLUTION)
        if read is None:
            return None
        header, arrays = read
        with self._readable(SOLUTION):
            stats = {name: arrays[f"stats.{name}"] for name in header["stats"]}
            answer = arrays["M"], MEMBERS[header["result"]], arrays["steps"], stats
            self._streamed.ended()
            M, result, steps, stats = jax.tree.map(jnp.asarray, answer)
            return Solution(M, result, steps, self.history.all(), stats)

    def end(self, solution: Solution) -> None:
        arrays = {"M": solution.M, "steps": solution.steps, "stats": solution.stats}
        self._write(SOLUTION, arrays, result=name_of(solution.result), stats=list(solution.stats))

    def _write(self, name: str, arrays: Any, **header: Any) -> None:
        header |= {"format": FORMAT, "run": self._run, "history": self._streamed.flush()}
        write_arrays(self.folder / name, header, arrays)

    def _read(self, name: str) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
        try:
            with self._readable(name):
                header, arrays = read_arrays(self.folder / name, FORMAT)
                if header["run"] != self._run:
                    raise UnreadableError("the content of another run")
                return header, arrays
        except FileNotFoundError:
            return None

    @contextmanager
    def _readable(self, name: str) -> Iterator[None]:
        try:
            yield
        except (UnreadableError, KeyError, TypeError, ValueError) as error:
            raise self._unreadable(f"{name} with {error}") from error

    def _unreadable(self, what: str) -> InputError:
        required, remedy = "be as a run has left it", "Restore it from a copy, or begin in another folder."
        return fail("checkpoint", f"{self.folder} with {what}", required, remedy)


@contextmanager
def kept(folder: Any, parts: dict[str, Any], record: Any) -> Iterator[Kept]:
    """Hold a folder for a run; raises InputError where it is another's, or somebody works in it."""
    if not isinstance(folder, str | os.PathLike):
        raise fail("checkpoint", type(folder).__name__, "be the path of a folder", 'Pass for example "runs/first".')
    folder = Path(folder)
    required, remedy = "be a new folder, or that of an earlier call", "Pass another folder."
    if folder.exists() and not folder.is_dir():
        raise fail("checkpoint", f"{folder}, which is a file", required, remedy)
    if folder.is_dir() and not (folder / RUN).exists():
        others = [path.name for path in folder.iterdir() if path.name != LOCK and not path.name.startswith(".")]
        if others:
            raise fail("checkpoint", f"{folder}, which holds {sorted(others)[0]} and no {RUN}", required, remedy)
    with locked("checkpoint", folder):
        yield Kept(folder, parts, record)


def _versions() -> dict[str, str]:
    """What the bits of a result depend on, besides the run itself."""
    packages = {name: importlib.metadata.version(name) for name in ("jax", "jaxlib", "numpy", "scipy")}
    return packages | {"platform": f"{jax.default_backend()} {platform.machine()}"}


def _listed(versions: Any) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items()) if versions else "unknown ones"
