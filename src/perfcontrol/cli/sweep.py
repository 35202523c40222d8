"""`perfcontrol sweep`."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from perfcontrol.cli.app import app, configure_jax, console, in_words
from perfcontrol.cli.plans import AsJson, File, Seed, Settings, cost_of, new_folder
from perfcontrol.cli.progress import stages
from perfcontrol.cli.together import blocks

if TYPE_CHECKING:
    from perfcontrol.files.run import Run

SHOWN = 40  # rows of the table


@app.command()
def sweep(
    file: File = Path("problem.toml"),
    *,
    vary: Annotated[
        list[str], typer.Option(help="key=1,2,3 or key=0:1:11 (11 numbers from 0 to 1); again for a grid.")
    ],
    out: Annotated[Path, typer.Option(help="Folder that keeps every point.")] = Path("sweep"),
    seed: Seed = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Solve a problem at every point of a grid over any of its keys, such as perturbation.scale.weight.

    Finished points are kept: a sweep that was stopped goes on with `perfcontrol resume OUT`. `pc.load(OUT)` is an
    xarray Dataset over the grid. The exit status is 1 if some point did not end as asked.
    """
    configure_jax()
    from perfcontrol._checks import fail
    from perfcontrol.files.changing import changed
    from perfcontrol.files.document import read_document
    from perfcontrol.files.run import PROBLEM, read_record
    from perfcontrol.files.sweep import MOST, axis_of, begin_sweep, plan_at, points_of

    with in_words(f"read {file}"):
        document = read_document(file / PROBLEM if file.is_dir() else file)
        axes = dict(axis_of(text) for text in vary)
        if len(axes) < len(vary):
            raise fail("--vary", "a key twice", "name different keys", "Give all values of a key at once.")
        points = points_of(axes)
        if len(points) > MOST:
            raise fail("--vary", f"{len(points)} points", f"make at most {MOST}", "Use a coarser grid.")
        changed_document = changed(document, settings or [])
        for point in points:  # what is wrong anywhere is said before any work
            try:
                plan_at(changed_document, point)
            except ValueError as error:
                where = ", ".join(f"{key} = {value}" for key, value in point.items())
                raise fail("--vary", where, "be values that the problem takes", str(error)) from None
    with in_words(f"keep the sweep in {out}"), new_folder(out):
        begin_sweep(out, document, axes, settings=settings or [], seed=seed)
        fill(out, read_record(out), as_json)


def fill(folder: Path, record: dict[str, Any], as_json: bool) -> None:
    """Solve the points that are not finished, and show the whole; exit with 1 where one did not end as asked."""
    import dataclasses

    from perfcontrol.files.changing import changed
    from perfcontrol.files.run import now, write_record
    from perfcontrol.files.sweep import base_of, finished, plan_at, points_of, read_sweep
    from perfcontrol.results import save_dataset

    document = changed(base_of(folder), record["settings"])
    points = points_of(record["axes"])
    done = {number for number, _ in finished(folder)}
    read = (plan_at(document, point) for point in points)
    plans = read if record["seed"] is None else (dataclasses.replace(plan, seed=record["seed"]) for plan in read)
    with stages(transient=True) as show:
        for block in blocks(plans, len(points)):
            missing = set(block.places) - done
            if missing:
                for number, run in zip(block.places, block.solved(), strict=True):
                    if number in missing:
                        _keep_point(folder, number, points[number], run)
                done |= missing
                show("points", len(done) / len(points))
    dataset = read_sweep(folder, record)
    save_dataset(dataset, folder / "results.nc", {})
    write_record(folder, record | {"ended": now()})
    rows = [row for _, row in finished(folder)]
    if as_json:
        print(json.dumps(rows, indent=2, allow_nan=False, ensure_ascii=False))
    else:
        _show(rows, record["axes"], folder)
    raise typer.Exit(0 if all(row["numbers"]["success"] for row in rows) else 1)


def _keep_point(folder: Path, number: int, point: dict[str, Any], run: "Run") -> None:
    """Write what a point has given, its numbers last: they say that it is finished."""
    from perfcontrol._printing import public_name
    from perfcontrol.files.solutions import write_solution
    from perfcontrol.files.sweep import POINTS
    from perfcontrol.results import save_json
    from perfcontrol.solvers import Result

    solution = run.solution
    numbers: dict[str, Any] = {
        **cost_of(run.problem, solution.M, run.seed),
        "success": float(solution.result == Result.success),
        "steps": int(solution.steps),
        "seconds": run.seconds,
        **{name: float(value) for name, value in solution.stats.items() if not value.ndim},
    }
    known = {name: value for name, value in numbers.items() if isinstance(value, int | float) and math.isfinite(value)}
    row = {"point": point, "solver": public_name(run.solver), "result": Result[solution.result], "numbers": known}
    write_solution(solution, folder / POINTS / f"{number:06d}.npz")
    save_json(row, folder / POINTS / f"{number:06d}.json")


def _show(rows: list[dict[str, Any]], axes: dict[str, list[Any]], folder: Path) -> None:
    from perfcontrol.cli.app import shown

    table = Table(*axes, "cost", "steps", "seconds", "result")
    for row in rows[:SHOWN]:
        numbers = row["numbers"]
        cells = [shown(numbers.get(name)) for name in ("cost", "steps", "seconds")]
        ended = "ended as asked" if numbers["success"] else row["result"].split(":")[0]
        values = [f"{value:g}" if isinstance(value, float) else str(value) for value in row["point"].values()]
        table.add_row(*values, *cells, ended)
    console.print(table)
    more = f" ({len(rows) - SHOWN} more rows there)" if len(rows) > SHOWN else ""
    line = f"{len(rows)} points in {folder}{more}: pc.load({str(folder)!r}) is an xarray Dataset"
    console.print(line, highlight=False, markup=False, soft_wrap=True)
