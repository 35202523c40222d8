"""Problems, solutions and runs as files: nothing in them is executed."""

import os
from pathlib import Path
from typing import Any

from perfcontrol._checks import fail
from perfcontrol.files.building import Plan, read_plan
from perfcontrol.files.run import Run, read_record, read_run, write_run
from perfcontrol.files.solutions import read_solution, write_solution
from perfcontrol.files.sweep import read_sweep
from perfcontrol.files.writing import write_plan
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import Solution

__all__ = ["Run", "load", "save"]


def load(path: Any) -> Any:
    """What a file or folder holds: a problem (TOML), a solution (npz), a run or a sweep (its folder).

    Nothing in it is executed. Numbers come back bit for bit, in the precision that JAX is set to.

    Args:
        path: of the file or folder.

    Returns:
        A `PerformativeProblem`, a `Solution`, a `Run`, or of a sweep the xarray Dataset over its grid, NaN where points
        are not finished.

    Raises:
        InputError: no such file, or content that does not fit, with file, line, key and remedy.
        OSError: it cannot be read.
    """
    path = _path(path)
    if path.is_dir():
        record = read_record(path)
        return read_sweep(path, record) if record["kind"] == "sweep" else read_run(path)
    if path.suffix == ".toml":
        return read_plan(path).problem
    if path.suffix == ".npz":
        return read_solution(path)
    required = "end in .toml (a problem) or .npz (a solution), or be the folder of a run"
    raise fail("path", f"{path}", required, 'Name such a file, for example "problem.toml".')


def save(thing: Any, path: Any) -> None:
    """Write a problem (as TOML), a solution (npz) or a `Run` (a new folder), whole or not at all.

    Arrays of more than 400 numbers go into NPY files beside the TOML file.

    Args:
        thing: a `PerformativeProblem` whose parts hold no Python functions, a `Solution`, or a `Run`.
        path: of the file, ending in .toml or .npz; or of a new folder.

    Raises:
        InputError: something else, a Python function in a problem (which a file cannot hold), or a name that does not
            fit.
        OSError: it cannot be written.
    """
    path = _path(path)
    if isinstance(thing, PerformativeProblem):
        write_plan(Plan(thing), _ending(path, ".toml", "a problem"))
    elif isinstance(thing, Solution):
        write_solution(thing, _ending(path, ".npz", "a solution"))
    elif isinstance(thing, Run):
        write_run(thing, path)
    else:
        required = "be a problem, a solution, or a run such as pc.Run(problem, solution)"
        raise fail("thing", type(thing).__name__, required, "Save arrays with numpy.save.")


def _path(path: Any) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise fail("path", type(path).__name__, "be the path of a file", 'Pass for example "problem.toml".')
    return Path(path)


def _ending(path: Path, suffix: str, what: str) -> Path:
    if path.suffix != suffix:
        raise fail("path", f"{path}", f"end in {suffix}, as {what} is written", f"Pass {path.with_suffix(suffix)}.")
    return path
