"""Compiled programs kept on disk, so that the next process need not compile them again."""

import os
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from perfcontrol._checks import fail


def cache(path: str | os.PathLike[str]) -> None:
    """Keep every compiled program in a folder, for this process and those after it.

    Switches on JAX's persistent compilation cache, whatever a program's size and the time it took to compile: a
    first answer then takes a fraction of its time in every process but the first. This changes JAX's configuration,
    which nothing else in the library does; programs of other libraries are kept, too.

    Args:
        path: the folder, made if need be; several processes may share it.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    if not isinstance(path, str | os.PathLike):
        raise fail("path", type(path).__name__, "be the path of a folder", 'Pass for example pc.cache("~/.cache/jax").')
    folder = Path(path).expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".probe-{os.getpid()}"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        why = error.strerror or type(error).__name__
        raise fail("path", f"{folder} ({why})", "be a folder that can be written to", "Pass another folder.") from error
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    compilation_cache.reset_cache()  # what was compiled before has settled the question of a cache for JAX
