"""The `perfcontrol` command: what its subcommands share. JAX is imported inside them, so that help comes at once."""

import contextlib
import errno
import os
from collections.abc import Iterator
from typing import Any

import typer
from rich.console import Console
from typer.core import TyperGroup

ORDER = ("new", "solve", "certify", "simulate", "compare", "sweep", "resume", "report", "schema", "reproduce", "stocks")

console = Console()
errors = Console(stderr=True)


class Commands(TyperGroup):
    """The commands in the order of their use, none of which ends in a traceback because of what the system or the
    library refuses."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted(super().list_commands(ctx), key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER))

    def invoke(self, ctx: Any) -> Any:
        try:
            with in_words("go on"):
                return super().invoke(ctx)
        except (ValueError, ArithmeticError, MemoryError, RuntimeError) as error:
            raise _in_words_of_the_library(error) from None


def _in_words_of_the_library(error: Exception) -> Exception:
    """The exit for what the library refuses, and for numbers or arrays that are too large; else the error itself."""
    from perfcontrol._checks import InputError

    first = str(error).split("\n")[0]
    if isinstance(error, InputError):
        return refuse(str(error))
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in first or "Out of memory" in first:
        return refuse(f"there is not enough memory for this: {first[:200]}. Use a shorter horizon or fewer samples.", 1)
    if isinstance(error, OverflowError):
        return refuse(first, 1)
    return error


app = typer.Typer(cls=Commands, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)


class _Cache:
    wanted = True


@app.callback()
def root(
    no_cache: bool = typer.Option(False, "--no-cache", help="Keep no compiled programs on disk."),
) -> None:
    """Performative control of linear dynamical systems.

    Compiled programs are kept in the user's cache folder, or in the folder that PERFCONTROL_CACHE names.
    """
    _Cache.wanted = not no_cache


def refuse(message: str, status: int = 2) -> typer.Exit:
    """Say what is wrong and give the exit to raise."""
    errors.print(f"error: {message}", style="red", markup=False, highlight=False, soft_wrap=True)
    return typer.Exit(status)


@contextlib.contextmanager
def in_words(doing: str) -> Iterator[None]:
    """Errors of the operating system in words: what was tried, which file, what to do."""
    try:
        yield
    except BrokenPipeError:  # the reader has gone, as with `| head`: no error
        raise
    except OSError as error:
        where = error.filename2 or error.filename
        at = f" at {where}" if where and not doing.endswith(str(where)) else ""
        raise refuse(f"cannot {doing}{at}: {_why(error)}", 1) from None


def _why(error: OSError) -> str:
    remedies: dict[type[OSError] | int, str] = {
        PermissionError: "no permission. Choose a folder that you may write to, or change its permissions.",
        FileNotFoundError: "it does not exist. Check the path.",
        FileExistsError: "a file stands where a folder should be. Choose another path, or move that file.",
        NotADirectoryError: "a file stands where a folder should be. Choose another path, or move that file.",
        IsADirectoryError: "a folder stands where a file should be. Choose another path.",
        errno.ENOSPC: "the disk is full. Free some space, or choose another disk; what was finished is kept.",
        errno.EFBIG: "the file would be larger than is allowed. Raise the limit (ulimit -f), or choose another disk.",
        errno.EROFS: "the disk is read-only. Choose another path.",
        errno.ENAMETOOLONG: "the name is too long. Choose a shorter one.",
        errno.EDQUOT: "the disk quota is used up. Free some space; what was finished is kept.",
    }
    known = remedies.get(error.errno or 0) or remedies.get(type(error))
    return known or f"{error.strerror or error}. Check the path and the disk."


def configure_jax() -> None:
    """Double precision, one host device a core, compiled programs kept on disk."""
    import jax

    from perfcontrol._cache import cache
    from perfcontrol._checks import InputError
    from perfcontrol._files import cache_folder
    from perfcontrol.kernel import use_kernel

    jax.config.update("jax_enable_x64", True)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        with contextlib.suppress(RuntimeError):  # JAX runs already, called from a program of its own: keep its devices
            jax.config.update("jax_num_cpu_devices", cores)
    if _Cache.wanted and not jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        try:
            cache(cache_folder())
        except InputError as error:
            errors.print(f"note: compiled programs are not kept: {error}", markup=False, highlight=False)
    if os.environ.get("PERFCONTROL_KERNEL", "0") not in ("", "0"):
        use_kernel()


def shown(value: Any) -> str:
    """A table cell."""
    if value is None:
        return "unknown"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if isinstance(value, str) else f"{value:.3g}"
