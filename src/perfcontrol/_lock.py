"""A folder for one process at a time: the operating system frees the lock when its holder ends, in whatever way."""

import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from perfcontrol._checks import fail
from perfcontrol._files import naming

NAME = "lock"


@contextmanager
def locked(argument: str, folder: Path, name: str = NAME) -> Iterator[None]:
    """Hold `folder`, made if need be; raises InputError about `argument` where another process holds it.

    Processes that work in it together each have a `name` of their own.
    """
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with naming(folder / name):
        file = (folder / name).open("a+b")
    with file:
        if not _taken(file):
            file.seek(0)
            holder = file.read(200).decode(errors="replace").strip() or "another process"
            raise fail(
                argument,
                f"{folder}, which {holder} works in",
                "be a folder that no other run works in",
                "Wait for that run, end it, or pass another folder.",
            )
        with suppress(OSError):  # a full disk: who holds the folder is said for people only
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
            file.flush()
        yield


def _taken(file: IO[bytes]) -> bool:
    """Whether the lock could be had."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True
