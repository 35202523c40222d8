"""`perfcontrol compare`."""

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from perfcontrol.cli.app import app, configure_jax, console, in_words, shown
from perfcontrol.cli.plans import AsJson, File, Seed, Settings, cost_of, new_folder, plan_in, solved
from perfcontrol.cli.progress import stages
from perfcontrol.cli.solve import data_of

if TYPE_CHECKING:
    from perfcontrol.files.building import Plan

METHODS = ("StablePoint", "RRM", "PerformativeOptimum")


@app.command()
def compare(
    file: File = Path("problem.toml"),
    solver: Annotated[
        list[str] | None,
        typer.Option(help=f"RRM, or '{{type = \"RRM\", anderson = 3}}'; again for more ({', '.join(METHODS)})."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Keep every run in this new folder.")] = None,
    seed: Seed = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Solve one problem with several methods: what each finds, what that costs, how far it is from being stable.

    The method that the file names comes first. The exit status is 1 if one did not end as asked.
    """
    configure_jax()
    from perfcontrol._fingerprint import fingerprint
    from perfcontrol.files.building import part_from
    from perfcontrol.solvers import AbstractSolver

    with in_words(f"read {file}"):
        plan = plan_in(file, settings, seed)
    chosen = [part_from(text, AbstractSolver, "--solver") for text in solver or METHODS]
    if plan.solver is not None:
        own = fingerprint(plan.solver)
        chosen = [plan.solver, *(each for each in chosen if fingerprint(each) != own)]
    with contextlib.ExitStack() as stack:
        if out is not None:
            stack.enter_context(in_words(f"keep the runs in {out}"))
            stack.enter_context(new_folder(out))
        rows = _rows(plan, chosen, out)
    if as_json:
        print(json.dumps(rows, indent=2, allow_nan=False, ensure_ascii=False))
    else:
        _show(rows, out)
    raise typer.Exit(0 if all(row["success"] for row in rows) else 1)


def _rows(plan: "Plan", solvers: list[Any], out: Path | None) -> list[dict[str, Any]]:
    from perfcontrol._checks import InputError
    from perfcontrol._printing import public_name
    from perfcontrol.files.run import write_run
    from perfcontrol.response import residual

    rows: list[dict[str, Any]] = []
    with stages(transient=True) as show:
        for number, each in enumerate(solvers):
            show("methods", number / len(solvers))
            name = public_name(each)
            alike = sum(row["name"].split("-")[0] == name for row in rows)
            name += f"-{alike + 1}" if alike else ""
            try:
                run = solved(dataclasses.replace(plan, solver=each), lambda *_: None)
            except InputError as error:
                rows.append({"name": name, "success": False, "result": f"does not apply: {error}"})
                continue
            M = run.solution.M
            row = {"name": name, **data_of(run, cost_of(run.problem, M, run.seed))}
            with contextlib.suppress(InputError, OverflowError):  # not known for this problem
                row["residual"] = float(residual(run.problem, M))
            rows.append(row)
            if out is not None:
                write_run(run, out / name)
    return rows


def _show(rows: list[dict[str, Any]], out: Path | None) -> None:
    table = Table("method", "cost", "residual", "steps", "seconds", "result")
    for row in rows:
        cost = shown(row.get("cost")) + (f" ± {row['standard_error']:.2g}" if row.get("standard_error") else "")
        numbers = [shown(row.get(name)) for name in ("residual", "steps", "seconds")]
        table.add_row(row["name"], cost, *numbers, "ended as asked" if row["success"] else row["result"])
    console.print(table)
    console.print(
        "cost: in the world that the policy makes. residual: how far it is from being stable, relative.",
        highlight=False,
    )
    if out is not None:
        console.print(f"kept in {out}", highlight=False, markup=False)
