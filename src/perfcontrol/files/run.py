"""A run that is kept: one folder with the problem, the method, the seed, versions, and what came out."""

import datetime
import json
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from perfcontrol._checks import InputError, check_instance, check_integer, fail
from perfcontrol._files import written_whole
from perfcontrol._fingerprint import fingerprint
from perfcontrol._printing import Printed, Row, public_name
from perfcontrol.files.building import Plan, read_plan
from perfcontrol.files.document import read_text
from perfcontrol.files.labels import dataset_of
from perfcontrol.files.solutions import read_solution, write_solution
from perfcontrol.files.writing import write_plan
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.solvers import AbstractSolver, Result, Solution

FORMAT = "perfcontrol capsule 1"  # checkpoints are "perfcontrol run 1"
PROBLEM, RECORD, SOLUTION = "problem.toml", "run.json", "solution.npz"
CERTIFICATES, DATASET = "certificates.json", "results.nc"


@dataclass(frozen=True)
class Run(Printed):
    """A problem, how it was solved, and the solution: what `pc.save` keeps in a folder and `pc.load` brings back.

    Args:
        problem: the problem.
        solution: what `pc.solve` returned.
        solver: the method; None where that is not known.
        seed: of its randomness, `jax.random.key(seed)`.
        M0: where it started; None for the solver's own start.
        every: steps between two entries of the solution's history.
        certificates: verdicts as plain data, one dict a kind, as `perfcontrol certify --out` writes them.
        versions: of the packages that the numbers depend on; those in use unless told otherwise.
        seconds: that the solver took; None where that is not known.

    Raises:
        InputError: no problem, no solution, or one of another problem.
    """

    problem: PerformativeProblem
    solution: Solution
    solver: AbstractSolver | None = None
    seed: int = 0
    M0: Any = None
    every: int = 1
    certificates: tuple[dict[str, Any], ...] = ()
    versions: dict[str, str] = field(default_factory=lambda: _versions())
    seconds: float | None = None

    def __post_init__(self) -> None:
        check_problem(self.problem)
        check_instance("solution", self.solution, Solution, "pc.solve(problem, pc.StablePoint())")
        if self.solver is not None:
            check_instance("solver", self.solver, AbstractSolver, "pc.StablePoint()")
        if self.solution.M.shape != self.problem.policy_shape:
            got = f"a policy of shape {self.solution.M.shape}"
            raise fail("solution", got, f"hold one of shape {self.problem.policy_shape}", "Save batches one by one.")
        check_integer("seed", self.seed, 0)
        check_integer("every", self.every, 1)

    @property
    def dataset(self) -> Any:
        """An xarray Dataset: `policy`, `history` over `step`, and the statistics of the solver."""
        return dataset_of(self.problem, self.solution, self.every)

    @property
    def history(self) -> Any:
        """The policies by step, an xarray DataArray with axes step, lag, input and state."""
        return self.dataset["history"]

    def described(self) -> tuple[str, list[Row]]:
        _, rows = self.solution.described()
        method = "unknown" if self.solver is None else public_name(self.solver)
        verdicts = ", ".join(f"{row['kind']}: {_verdict(row)}" for row in self.certificates) or "none"
        kept = [("solver", method), ("seed", str(self.seed))]
        return "Run", [*kept, *rows, ("certificates", verdicts), ("perfcontrol", self.versions.get("perfcontrol", "?"))]


def _verdict(row: dict[str, Any]) -> str:
    return {True: "holds", False: "does not hold", None: "not applicable"}[row["holds"]]


def _versions() -> dict[str, str]:
    from perfcontrol.results import versions

    return versions()


def write_run(run: Run, folder: Path) -> None:
    """Write a run into a new folder, whole or not at all."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise fail("path", f"{folder}, which exists", "be a new folder", "Choose another name, or remove it.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        begin(temporary, Plan(run.problem, run.solver, run.M0, run.seed), every=run.every)
        end(temporary, run)
        temporary.chmod(0o755)  # mkdtemp makes folders private; results are for everyone whom the folder is for
        temporary.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def begin(folder: Path, plan: Plan, **settings: Any) -> None:
    """What a run begins with: the problem, and the record of what is to be done."""
    write_plan(plan, folder / PROBLEM)
    begin_record(folder, "solve", **settings)


def begin_record(folder: Path, kind: str, **settings: Any) -> None:
    """The record of what is to be done in a folder."""
    write_record(folder, {"format": FORMAT, "kind": kind, "ended": None, "began": now(), **settings})


def end(folder: Path, run: Run) -> None:
    """Everything that came out, the record last: it says that the rest is there."""
    write_solution(run.solution, folder / SOLUTION)
    _write_json(list(run.certificates), folder / CERTIFICATES)
    from perfcontrol.results import save_dataset

    plain = {"seed": run.seed, "problem": fingerprint(run.problem)}
    save_dataset(run.dataset, folder / DATASET, plain)
    record = read_record(folder)
    ended = {
        "ended": now(),
        "seconds": run.seconds,
        "result": Result[run.solution.result],
        "every": run.every,
        "solver": run.solver is not None,
        "versions": run.versions,
        "problem": fingerprint(run.problem),
    }
    write_record(folder, record | ended)


def read_run(folder: Path) -> Run:
    """The run in a folder."""
    record = read_record(folder)
    if record.get("kind") != "solve":
        raise fail(
            "path",
            f"{folder}, a {record.get('kind')}",
            "be the folder of a run",
            "Pass it to pc.load, which opens it as a grid.",
        )
    if not record.get("ended"):
        remedy = f"Go on with `perfcontrol resume {folder}`."
        raise fail("path", f"{folder}, a run that has not ended", "be the folder of a finished run", remedy)
    plan = read_plan(folder / PROBLEM)
    solution = read_solution(folder / SOLUTION)
    certificates = tuple(json.loads(read_text(folder / CERTIFICATES, 2**26, "")))
    kept = (record["every"], certificates, record["versions"], record["seconds"])
    return Run(plan.problem, solution, plan.solver, plan.seed, plan.M0, *kept)


def read_record(folder: Path) -> dict[str, Any]:
    """What is known of the run in a folder; raises InputError where there is none."""
    required = "be a folder that a run was kept in"
    if not (folder / RECORD).is_file():
        raise fail(
            "path",
            f"{folder}, without {RECORD}",
            required,
            "Run `perfcontrol solve FILE --out FOLDER`, which makes one.",
        )
    try:
        record = json.loads(read_text(folder / RECORD, 2**20, ""))
        if record["format"] != FORMAT:
            raise KeyError(record["format"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise fail("path", f"{folder / RECORD} ({error})", required, "Run it again.") from None
    return record


def write_record(folder: Path, record: dict[str, Any]) -> None:
    """Write what is known of a run."""
    _write_json(record, folder / RECORD)


def _write_json(data: Any, path: Path) -> None:
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def now() -> str:
    """The time, in UTC."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
