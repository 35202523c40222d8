"""The kernel as a library: compiled by the machine's own compiler, kept, loaded into JAX, switched on and off."""

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import threading
from pathlib import Path

import jax
import jaxlib

from perfcontrol._checks import fail
from perfcontrol._files import cache_folder, written_whole

SOURCES = Path(__file__).parent / "source"
COMPILERS = ("c++", "g++", "clang++")
# Sums may be taken in any order where a loop says so, and nowhere else: what is not finite stays so.
FLAGS = ("-std=c++17", "-O3", "-fPIC", "-shared", "-fopenmp-simd", "-fno-math-errno", "-fno-trapping-math", "-w")
FOR_THIS_PROCESSOR = "-march=native"  # not every compiler knows it
TARGET = "perfcontrol_paths"
WAIT = 300  # seconds that a compiler may take


class _Switch:
    on = False
    loaded = False
    lock = threading.Lock()


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
    with _Switch.lock:
        if on and not _Switch.loaded:
            jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(_loaded().PerfcontrolPaths), platform="cpu")
            _Switch.loaded = True
        if on != _Switch.on:
            _Switch.on = on
            jax.clear_caches()


def _loaded() -> ctypes.CDLL:
    """The library; compiled once more where what was kept does not load."""
    try:
        return ctypes.CDLL(str(compiled()))
    except OSError:
        compiled().unlink(missing_ok=True)
    library = compiled()
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:
        remedy = "Keep it elsewhere: set PERFCONTROL_CACHE to a folder from which programs may be loaded."
        raise fail("PERFCONTROL_CACHE", str(error), "hold a library that loads", remedy) from error


def _compiler() -> list[str]:
    """The command of a C++ compiler: $CXX, or the first of `COMPILERS` there is."""
    named = os.environ.get("CXX")
    for command in [shlex.split(named)] if named else [[name] for name in COMPILERS]:
        found = shutil.which(command[0]) if command else None
        if found:
            return [found, *command[1:]]
    got = named or f"none of {', '.join(COMPILERS)}"
    raise fail("CXX", got, "name a C++17 compiler of this machine", "Install one, such as g++, or set CXX to its path.")


def _processor() -> str:
    """What programs for this processor do not share with those for others."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    return next((line for line in lines if line.startswith("flags")), f"{platform.node()} {platform.processor()}")


def _is_own(library: Path) -> bool:
    """Whether the file is there and nobody else could have written it: what is loaded is executed."""
    if not library.exists():
        return False
    about = library.stat()
    return os.name != "posix" or (about.st_uid == os.geteuid() and not about.st_mode & 0o022)


def compiled() -> Path:
    """The library, compiled unless that was done before for the same source, compiler, JAX and machine."""
    compiler = _compiler()
    machine = [platform.system(), platform.machine(), *platform.libc_ver(), _processor()]
    made_of = [*compiler, *FLAGS, FOR_THIS_PROCESSOR, jaxlib.__version__, *machine]
    digest = hashlib.sha256("\n".join(made_of).encode())
    for source in sorted(SOURCES.iterdir()):
        digest.update(source.read_bytes())
    library = cache_folder() / "kernel" / f"{digest.hexdigest()[:32]}.so"
    if not _is_own(library):
        try:
            _compile(compiler, library)
        except OSError as error:
            got = f"{library.parent} ({error.strerror or type(error).__name__})"
            raise fail("PERFCONTROL_CACHE", got, "be a folder that can be written to", "Name another one.") from error
    return library


def _compile(compiler: list[str], library: Path) -> None:
    with written_whole(library) as made:
        said = _errors(compiler, [FOR_THIS_PROCESSOR], made) and _errors(compiler, [], made)
        if said:
            remedy = "Name another compiler: CXX=g++. Without the kernel everything works as well, only slower."
            raise fail("CXX", f"{' '.join(compiler)}, which said: {said}", "compile the kernel (C++17)", remedy)


def _errors(compiler: list[str], extra: list[str], library: Path) -> str:
    """Compile; what went wrong, in a line, or nothing."""
    flags = [*FLAGS, *extra, f"-I{SOURCES}", "-isystem", jax.ffi.include_dir()]
    command = [*compiler, *flags, str(SOURCES / "paths.cc"), "-o", str(library)]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=WAIT)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if run.returncode == 0:
        return ""
    lines = run.stderr.strip().splitlines() or [f"exit status {run.returncode}"]
    return next((line for line in lines if "error" in line), lines[0])
