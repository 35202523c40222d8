"""A TOML file as tables, and errors that say where in it something is wrong."""

import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from perfcontrol._checks import InputError, fail
from perfcontrol.files.lines import Key, lines_of

LARGEST = 8 * 2**20  # bytes of a TOML file: larger matrices belong in files beside it


@dataclass(frozen=True)
class Document:
    """What a file says, and where."""

    path: Path
    text: str
    tables: Mapping[str, Any]
    _lines: dict[Key, int] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        """Where files beside it are looked for."""
        return self.path.parent

    def line(self, key: Key) -> int | None:
        """The line of a key, or of the nearest one around it."""
        if not self._lines:
            self._lines.update(lines_of(self.text))
        while key and key not in self._lines:
            key = key[:-1]
        return self._lines.get(key)


@dataclass(frozen=True)
class Place:
    """A key of a document."""

    document: Document
    key: Key = ()

    def __truediv__(self, part: str | int) -> "Place":
        return Place(self.document, (*self.key, part))

    def fault(self, got: str, required: str, remedy: str) -> InputError:
        """The error about what stands here."""
        return self.wrong(f"`{spelt(self.key) or 'the file'}` must {required}; got {got}. {remedy}")

    def wrong(self, message: str) -> InputError:
        """The error with a message of its own."""
        line = self.document.line(self.key)
        return InputError(f"{self.document.path.name}{'' if line is None else f', line {line}'}: {message}")


def spelt(key: Key) -> str:
    """A key as one writes it, with dots and indices."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).lstrip(".")


def read_document(path: Path) -> Document:
    """Read a TOML file; raises InputError with the line where it is none."""
    text = read_text(path, LARGEST, "Put large matrices into NPY files beside it, and write their names.")
    return Document(path, text, parsed(text, path.name))


def read_text(path: Path, largest: int, remedy: str) -> str:
    """The text of a regular file of limited size."""
    raw = read_bytes(path, largest, remedy)
    try:
        return raw.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        message = f"{path.name}, line {line}: the file must be text in UTF-8; got the byte 0x{raw[error.start]:02x}."
        raise InputError(f"{message} Save it as UTF-8.") from None


def read_bytes(path: Path, largest: int, remedy: str) -> bytes:
    """The content of a regular file of limited size, which is asked before anything is read."""
    with path.open("rb") if _regular(path) else _refused(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest:
            got = f"{path} of {size / 2**20:.1f} MiB"
            raise fail("path", got, f"be a file of at most {largest / 2**20:g} MiB", remedy)
        return file.read(largest)


def _regular(path: Path) -> bool:
    try:
        return path.is_file()
    except ValueError:  # a null byte
        return False


def _refused(path: Path) -> NoReturn:
    got = (
        "which is a folder"
        if path.is_dir()
        else "which is no regular file"
        if path.exists()
        else "which does not exist"
    )
    raise fail("path", f"{path}, {got}", "be a file", "Name one that exists; `perfcontrol new` writes a first one.")


def parsed(text: str, name: str) -> dict[str, Any]:
    """The tables of a TOML text."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        what, _, where = str(error).partition(" (at ")
        line = re.match(r"line (\d+), column (\d+)", where)
        at = f", line {line[1]}" if line else ""
        column = f" (column {line[2]})" if line else " (end of the file)" if where else ""
        twice = re.search(r"overwrite a value|declare .* twice|Duplicate|already|mutate", what)
        remedy = "A key or table is given twice: remove one." if twice else "See https://toml.io for its rules."
        raise InputError(f"{name}{at}: the file must be valid TOML; got: {what}{column}. {remedy}") from None
    except RecursionError:
        raise InputError(f"{name}: lists or tables are nested too deeply. Write matrices as lists of rows.") from None
    except ValueError:  # of what is no TOMLDecodeError
        raise InputError(f"{name}: a whole number has thousands of digits. Use numbers of a reasonable size.") from None
