"""A folder of one run: what is run, in words that tell it from others, and files that belong to it alone."""

import importlib.metadata
import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from perfcontrol._array_files import UnreadableError, read_arrays, write_arrays
from perfcontrol._checks import InputError, fail
from perfcontrol._files import leftovers, naming, written_whole
from perfcontrol._fingerprint import fingerprint
from perfcontrol._lock import NAME as LOCK
from perfcontrol._lock import locked
from perfcontrol.kernel import in_use

FORMAT = "perfcontrol run 1"
RUN = "run.json"


class RunFolder:
    """A folder that this process holds, and its files of arrays.

    Args:
        path: where.
        parts: what is run: the folder of other parts is refused.
    """

    def __init__(self, path: Path, parts: dict[str, Any]):
        self.path = path
        told = {name: part if isinstance(part, int) else fingerprint(part) for name, part in parts.items()}
        self._run = fingerprint(told)
        with naming(path):
            path.mkdir(exist_ok=True)
        if not (path / RUN).exists():
            with written_whole(path / RUN) as temporary:
                temporary.write_text(json.dumps({"format": FORMAT, **told, "versions": _versions()}, indent=1))
        self._made_with = self._compared(told)

    def _compared(self, told: dict[str, Any]) -> Any:
        """The versions that the run was begun with, if it is this one."""
        try:
            content = json.loads((self.path / RUN).read_text())
            if not isinstance(content, dict) or content.get("format") != FORMAT:
                raise ValueError(FORMAT)
        except ValueError as error:
            raise self._unreadable(f"{RUN} with other content") from error
        for name, value in told.items():
            if content.get(name) != value:
                required = f"hold a run of the same {name}"
                raise fail("checkpoint", f"{self.path}, of another {name}", required, "Pass another folder.")
        return content.get("versions")

    def check_versions(self) -> None:
        """Raise unless this process computes the bits that the run was begun with."""
        if self._made_with != _versions():
            required = f"be of a run begun with the versions that go on with it, {_listed(_versions())}"
            got = f"{self.path}, begun with {_listed(self._made_with)}"
            raise fail("checkpoint", got, required, "Use those versions again, or begin in another folder.")

    def write(self, name: str, tree: Any, **header: Any) -> None:
        """Write a tree of arrays, and what else is to be known of it."""
        write_arrays(self.path / name, header | {"format": FORMAT, "run": self._run}, tree)

    def read(self, name: str) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
        """Header and arrays of a file of this run; None where there is none."""
        try:
            with self.readable(name):
                header, arrays = read_arrays(self.path / name, FORMAT)
                if header["run"] != self._run:
                    raise UnreadableError("the content of another run")
                return header, arrays
        except FileNotFoundError:
            return None

    def sweep(self, *names: str) -> None:
        """Remove what killed writers of these files have left."""
        for name in (RUN, *names):
            for leftover in leftovers(self.path / name):
                leftover.unlink(missing_ok=True)

    @contextmanager
    def readable(self, name: str) -> Iterator[None]:
        """Content that does not fit is an error about the folder."""
        try:
            yield
        except (UnreadableError, KeyError, TypeError, ValueError) as error:
            raise self._unreadable(f"{name} with {error}") from error

    def _unreadable(self, what: str) -> InputError:
        required, remedy = "be as a run has left it", "Restore it from a copy, or begin in another folder."
        return fail("checkpoint", f"{self.path} with {what}", required, remedy)


@contextmanager
def held(folder: Any, process: int | None = None) -> Iterator[Path]:
    """Hold a folder for a run, or for one process of it; raises InputError where it is no run's, or in use."""
    if not isinstance(folder, str | os.PathLike):
        raise fail("checkpoint", type(folder).__name__, "be the path of a folder", 'Pass for example "runs/first".')
    folder = Path(folder)
    required, remedy = "be a new folder, or that of an earlier call", "Pass another folder."
    if folder.exists() and not folder.is_dir():
        raise fail("checkpoint", f"{folder}, which is a file", required, remedy)
    if folder.is_dir() and not (folder / RUN).exists():
        others = [path.name for path in folder.iterdir() if not path.name.startswith((LOCK, "."))]
        if others:
            raise fail("checkpoint", f"{folder}, which holds {sorted(others)[0]} and no {RUN}", required, remedy)
    with locked("checkpoint", folder, LOCK if process is None else f"{LOCK}-{process}"):
        yield folder


def _versions() -> dict[str, str]:
    """What the bits of a result depend on, besides the run itself."""
    packages = {name: importlib.metadata.version(name) for name in ("jax", "jaxlib", "numpy", "scipy")}
    kernel = {"kernel": "in use"} if in_use() else {}
    return packages | {"platform": f"{jax.default_backend()} {platform.machine()}"} | kernel


def _listed(versions: Any) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items()) if versions else "unknown ones"
