"""What a run records: rows held in memory, or streamed to files as they come."""

import io
import math
import os
import zlib
from pathlib import Path
from typing import IO, Any

import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._array_files import UnreadableError
from perfcontrol._files import naming
from perfcontrol._programs import numerics

PIECE = 1 << 24  # bytes written or checked at a time


class Held:
    """Rows in memory."""

    def __init__(self) -> None:
        self.rows = 0
        self._parts: list[Any] = []

    def add(self, rows: Any) -> None:
        """Append a pytree of arrays with a leading axis."""
        self._parts.append(rows)
        self.rows += len(jax.tree.leaves(rows)[0])

    def repeat(self, count: int) -> None:
        """The last row again: what a run that ended early lacks to be as long as under jit."""
        last = self._parts[-1]
        self.add(jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[-1:], count, axis=0), last))

    def all(self) -> Any:
        """Every row."""
        return jax.tree.map(jnp.asarray, joined(self._parts))


class Streamed:
    """Rows in files of NumPy's npy format, one a leaf; `flush` writes what was added since the last one.

    A file's header says from the start how long it will be.
    """

    def __init__(self, folder: Path, row: Any, length: int):
        leaves, self._structure = jax.tree.flatten(row)
        names = ["history"] if len(leaves) == 1 else [f"history.{i}" for i in range(len(leaves))]
        self._files = [_RowFile(folder / f"{name}.npy", leaf, length) for name, leaf in zip(names, leaves, strict=True)]
        self.rows, self._length = 0, length
        self._waiting: list[list[Any]] = []
        self._newest: list[Any] = []

    def add(self, rows: Any) -> None:
        """Append a pytree of arrays with a leading axis."""
        self._newest = jax.tree.leaves(rows)
        self._waiting.append(self._newest)
        self.rows += len(self._newest[0])

    def repeat(self, count: int) -> None:
        """The last row again."""
        last = [np.asarray(leaf)[-1:] for leaf in self._newest]
        self.add([np.broadcast_to(leaf, (count, *leaf.shape[1:])) for leaf in last])

    def begin(self) -> None:
        """Make the files, without rows."""
        for file in self._files:
            file.begin()

    def resume(self, marks: list[tuple[int, int]]) -> None:
        """Go back to what `flush` returned; raises UnreadableError where those rows are not there."""
        if len(marks) != len(self._files):
            raise UnreadableError("other records")
        for file, (rows, check) in zip(self._files, marks, strict=True):
            file.resume(rows, check)
        self.rows = marks[0][0]
        self._newest = [file.mapped()[self.rows - 1 : self.rows] for file in self._files]

    def ended(self) -> None:
        """Go to the end of a run that has ended."""
        self.rows = self._length
        for file in self._files:
            file.rows = self._length

    def flush(self) -> list[tuple[int, int]]:
        """Write what waits; for each leaf the number of its rows and their checksum."""
        marks = [file.write([leaves[index] for leaves in self._waiting]) for index, file in enumerate(self._files)]
        self._waiting = []
        return marks

    def all(self) -> Any:
        """Every row, in memory maps that cannot be written to."""
        self.flush()
        return jax.tree.unflatten(self._structure, [file.mapped() for file in self._files])


class _RowFile:
    """The rows of one leaf."""

    def __init__(self, path: Path, row: Any, length: int):
        self.path, self.dtype, self.shape = path, np.dtype(row.dtype), (length, *row.shape)
        self.width = self.dtype.itemsize * math.prod(row.shape)  # bytes of a row
        self.rows = self.check = 0
        described = {"descr": np.lib.format.dtype_to_descr(self.dtype), "fortran_order": False, "shape": self.shape}
        header = io.BytesIO()
        np.lib.format.write_array_header_2_0(header, described)
        self.header = header.getvalue()

    def begin(self) -> None:
        with naming(self.path), self.path.open("wb") as file:
            file.write(self.header)

    def write(self, parts: list[Any]) -> tuple[int, int]:
        with naming(self.path), self.path.open("r+b") as file:
            file.seek(self._place(self.rows))
            for part in parts:
                for first in range(0, len(part), self._step()):
                    rows = np.ascontiguousarray(np.asarray(part[first : first + self._step()], self.dtype))
                    file.write(rows.tobytes())
                    self.check = zlib.crc32(rows.tobytes(), self.check)
                self.rows += len(part)
            file.flush()
            os.fsync(file.fileno())
        return self.rows, self.check

    def resume(self, rows: int, check: int) -> None:
        """Leave so many rows; whatever was written after them has no mark."""
        try:
            with naming(self.path), self.path.open("r+b") as file:
                if file.read(len(self.header)) != self.header or not 0 < rows <= self.shape[0]:
                    raise UnreadableError(f"another {self.path.name}")
                self.rows, self.check = rows, _checksum(file, rows * self.width)
                file.truncate(self._place(rows))
        except FileNotFoundError as error:
            raise UnreadableError(f"no {self.path.name}") from error
        if self.check != check:
            raise UnreadableError(f"a changed {self.path.name}")

    def mapped(self) -> np.ndarray:
        if not self.path.exists() or self.path.stat().st_size < self._place(self.rows):
            raise UnreadableError(f"a shortened {self.path.name}")
        shape = (self.rows, *self.shape[1:])
        if not self.width:
            return np.empty(shape, self.dtype)
        return np.memmap(self.path, self.dtype, "r", len(self.header), shape)

    def _place(self, row: int) -> int:
        return len(self.header) + row * self.width

    def _step(self) -> int:
        return max(1, PIECE // max(1, self.width))


def _checksum(file: IO[bytes], length: int) -> int:
    """Of the next `length` bytes, or as many as there are."""
    check = 0
    while length > 0 and (piece := file.read(min(PIECE, length))):
        check, length = zlib.crc32(piece, check), length - len(piece)
    return check


def joined(parts: list[Any]) -> Any:
    """Pytrees of rows as one."""
    xp, _ = numerics(parts)
    return jax.tree.map(lambda *leaves: xp.concatenate(leaves), *parts)
