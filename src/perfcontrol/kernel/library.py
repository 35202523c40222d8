"""The kernel as a library: compiled by the machine's own compiler, kept, loaded into JAX, switched on and off."""

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
from pathlib import Path

import jax
import jaxlib

from perfcontrol._checks import fail
from perfcontrol._files import cache_folder, written_whole

SOURCES = Path(__file__).parent / "source"
COMPILERS = ("c++", "g++", "clang++")
# Sums may be taken in any order where a loop says so, and nowhere else: what is not finite stays so.
FLAGS = ("-std=c++17", "-O3", "-fPIC", "-shared", "-fopenmp-simd", "-w")
FOR_THIS_PROCESSOR = "-march=native"  # not every compiler knows it
TARGET = "perfcontrol_paths"
WAIT = 300  # seconds that a compiler may take


class _Switch:
    on = False
    loaded = False


def in_use() -> bool:
    """Whether the kernel is switched on, and JAX works on a CPU."""
    return _Switch.on and jax.default_backend() == "cpu"


def use_kernel(on: bool = True) -> None:
    """Switch the kernel on or off: sampled costs and gradients under dense perturbations at several times the speed.

    `pc.sample_gradient`, `pc.estimate_cost` and `pc.RSGD` with its own gradient, by `pc.solve` or `pc.solve_many`, then
    work on paths in C++ where the cost is quadratic, the perturbation a `pc.DensePerturbation` of the state (or none)
    and the device a CPU; all else stays as it is. The numbers are the same to rounding: a key draws what it always
    draws. The kernel is compiled for this machine the first time, in a few seconds, and kept. The switch makes JAX
    forget what it had compiled, other packages' programs too.

    Args:
        on: False switches it off.

    Raises:
        InputError: neither True nor False; there is no C++ compiler, or it fails.

    Examples:
        >>> import perfcontrol as pc
        >>> pc.use_kernel(False)
    """
    if not isinstance(on, bool):
        raise fail("on", repr(on), "be True or False", "Write pc.use_kernel() or pc.use_kernel(False).")
    if on and not _Switch.loaded:
        library = ctypes.CDLL(str(compiled()))
        jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(library.PerfcontrolPaths), platform="cpu")
        _Switch.loaded = True
    if on != _Switch.on:
        _Switch.on = on
        jax.clear_caches()


def _compiler() -> str:
    """The command of a C++ compiler: $CXX, or the first of `COMPILERS` there is."""
    named = os.environ.get("CXX")
    for command in (named,) if named else COMPILERS:
        found = shutil.which(command)
        if found:
            return found
    required = "find a compiler of C++17 on this machine"
    raise fail(
        "CXX", named or f"none of {', '.join(COMPILERS)}", required, "Install one, such as g++, or name it: CXX."
    )


def _processor() -> str:
    """What programs for this processor do not share with those for others."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    return next((line for line in lines if line.startswith("flags")), f"{platform.node()} {platform.processor()}")


def compiled() -> Path:
    """The library, compiled unless that was done before for the same source, compiler, JAX and processor."""
    compiler = _compiler()
    made_of = [compiler, *FLAGS, FOR_THIS_PROCESSOR, jaxlib.__version__, platform.machine(), _processor()]
    digest = hashlib.sha256("\n".join(made_of).encode())
    for source in sorted(SOURCES.iterdir()):
        digest.update(source.read_bytes())
    library = cache_folder() / "kernel" / f"{digest.hexdigest()[:32]}.so"
    if not library.exists():
        with written_whole(library) as made:
            said = _errors(compiler, FOR_THIS_PROCESSOR, made) and _errors(compiler, None, made)
            if said:
                remedy = "Name another compiler: CXX=g++. Without the kernel everything works as well, only slower."
                raise fail("CXX", f"{compiler}, which said: {said}", "compile the kernel (C++17)", remedy)
    return library


def _errors(compiler: str, extra: str | None, library: Path) -> str:
    """Compile; what went wrong, in a line, or nothing."""
    flags = [*FLAGS, *([extra] if extra else []), f"-I{SOURCES}", "-isystem", jax.ffi.include_dir()]
    command = [compiler, *flags, str(SOURCES / "paths.cc"), "-o", str(library)]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=WAIT)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if run.returncode == 0:
        return ""
    lines = run.stderr.strip().splitlines() or [f"exit status {run.returncode}"]
    return next((line for line in lines if "error" in line), lines[0])
