"""Files written whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place when the block ends well, and vanishes otherwise.

    What took its place is on the disk, and not in a buffer. An OSError names `path`, or the file in its way, and never
    the temporary one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with naming(path):
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            # mkstemp makes files private; results are for everyone whom the folder is for
            temporary.chmod(0o644)
            _flush(temporary, os.O_RDWR)
            os.replace(temporary, path)
            if os.name == "posix":  # elsewhere folders cannot be opened
                _flush(path.parent, os.O_RDONLY)
        finally:
            temporary.unlink(missing_ok=True)


def leftovers(path: Path) -> list[Path]:
    """Temporary files of writers of `path` that were killed; nobody may be writing it now."""
    return list(path.parent.glob(f".{path.stem}.*{path.suffix}"))


def _flush(path: Path, mode: int) -> None:
    handle = os.open(path, mode)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def cache_folder() -> Path:
    """Where compiled programs are kept: $PERFCONTROL_CACHE, or a folder of the user's own."""
    named = os.environ.get("PERFCONTROL_CACHE")
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(named) if named else base / "perfcontrol"


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the operating system inside are about `path`; a full disk says of itself not even which file."""
    try:
        yield
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise
