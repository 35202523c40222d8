"""What the commands about a problem file share: reading it with changes, and carrying out what it asks for."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from perfcontrol.files.building import Plan
    from perfcontrol.files.run import Run

RECORDED = 1000  # entries of a history, about

File = Annotated[Path, typer.Argument(help="Problem file (TOML), or the folder of a run.")]
Seed = Annotated[int | None, typer.Option(help="Of all randomness (that of the file).", min=0, max=2**32 - 1)]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="key=value, in place of what the file says; may be given again.", metavar="KEY=VALUE"),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the outcome as JSON, nothing else.")]


def plan_in(path: Path, settings: list[str] | None = None, seed: int | None = None) -> "Plan":
    """The plan of a problem file or run folder, with changes."""
    from perfcontrol._checks import fail
    from perfcontrol.files.building import plan_of
    from perfcontrol.files.changing import changed
    from perfcontrol.files.document import read_document
    from perfcontrol.files.run import PROBLEM

    if not path.exists():
        raise fail(
            "file",
            f"{path}, which does not exist",
            "be a problem file",
            f"Run `perfcontrol new {path}`, which writes one.",
        )
    document = read_document(path / PROBLEM if path.is_dir() else path)
    plan = plan_of(changed(document, settings or []))
    return plan if seed is None else replace(plan, seed=seed)


def recorded_every(solver: Any) -> int:
    """Steps between two entries of the history of a solver's run."""
    return max(1, -(-solver.max_steps // RECORDED))


def solved(
    plan: "Plan", progress: Callable[[str, float], None], kinds: tuple[str, ...] = (), checkpoint: Path | None = None
) -> "Run":
    """What a plan asks for, carried out; a failure is a result, too."""
    import jax

    from perfcontrol.files.run import Run
    from perfcontrol.solvers import StablePoint, solve
    from perfcontrol.theory import verdict_rows

    solver = plan.solver or StablePoint()
    every = recorded_every(solver)
    key = jax.random.key(plan.seed)
    began = time.perf_counter()
    found = solve(
        plan.problem,
        solver,
        plan.M0,
        key=key,
        every=every,
        throw=False,
        progress=lambda done, total: progress("solving", done / total),
        checkpoint=checkpoint,
    )
    seconds = time.perf_counter() - began
    rows: list[dict[str, Any]] = []
    for number, kind in enumerate(kinds):
        progress("certifying", number / len(kinds))
        rows += verdict_rows(plan.problem, (kind,), key=key)
    return Run(plan.problem, found, solver, plan.seed, plan.M0, every, tuple(rows), seconds=round(seconds, 3))


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Hold a folder that is empty."""
    from perfcontrol._checks import fail
    from perfcontrol._lock import NAME, locked

    with locked("out", folder):
        others = sorted(entry.name for entry in folder.iterdir() if entry.name != NAME)
        if others:
            remedy = f"Choose another folder, or go on there with `perfcontrol resume {folder}`."
            raise fail("out", f"{folder}, which holds {others[0]}", "be a new folder", remedy)
        yield


def cost_of(problem: Any, M: Any, seed: int, samples: int = 4096) -> dict[str, Any]:
    """C(M; M): exact where moments are known, else estimated with its standard error; None with the reason where it
    overflows."""
    import jax

    from perfcontrol._checks import InputError
    from perfcontrol.evaluate import estimate_cost, expected_cost

    try:
        return {"cost": float(expected_cost(problem, M)), "standard_error": None}
    except OverflowError as error:
        return {"cost": None, "standard_error": None, "why": str(error)}
    except InputError:
        estimate = estimate_cost(problem, M, key=jax.random.fold_in(jax.random.key(seed), 1), samples=samples)
        cost, error = float(estimate.mean), float(estimate.standard_error)
        if not (math.isfinite(cost) and math.isfinite(error)):
            return {"cost": None, "standard_error": None, "why": "it overflows at this policy"}
        return {"cost": cost, "standard_error": error}
