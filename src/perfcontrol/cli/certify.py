"""`perfcontrol certify`."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.table import Table

from perfcontrol.cli.app import app, configure_jax, console, in_words, refuse, shown
from perfcontrol.cli.plans import AsJson, Seed, Settings, plan_in
from perfcontrol.cli.progress import stages


@app.command()
def certify(
    problem_name: Annotated[
        str | None,
        typer.Argument(
            metavar="[stock|FILE]",
            help="The paper's stock market, a problem file, or a run.",
            show_default="problem.toml where there is one, else stock",
        ),
    ] = None,
    order: Annotated[
        Literal["ascending", "descending", "random"],
        typer.Option(help="Of stock: sensitivities over time."),
    ] = "ascending",
    growth: Annotated[float, typer.Option(help="Of stock: rho in A = rho I.")] = 1.0,
    feasible_set: Annotated[
        Literal["rows", "simplex"], typer.Option(help="Of stock: row sums, or nonnegative as well.")
    ] = "rows",
    batch: Annotated[int, typer.Option(help="Paths per step, for the safe step.", min=1)] = 1,
    kind: Annotated[
        list[str] | None, typer.Option(help="paper, rigorous, global or sharp; may be given again (all).")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Also write the verdicts to this JSON file.")] = None,
    seed: Seed = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Say whether a stable policy exists, how fast it is reached, and which step is safe; and how each is known.

    The exit status is 0 if a certificate holds and 3 if none does.
    """
    configure_jax()
    import jax

    from perfcontrol.experiments.stock import stock_market
    from perfcontrol.theory import KINDS, verdict_rows

    for given in kind or ():
        if given not in KINDS:
            raise refuse(f"--kind: must be one of {', '.join(KINDS)}; got {given!r}.")

    if problem_name is None:
        problem_name = "problem.toml" if Path("problem.toml").exists() else "stock"
    if problem_name == "stock":
        problem, title = stock_market(order, growth=growth, feasible_set=feasible_set), f"stock, {order}, {growth:g}"
    else:
        title, path = problem_name, Path(problem_name)
        with in_words(f"read {path}"):
            plan = plan_in(path, settings, seed)
        problem, seed = plan.problem, plan.seed
    kinds = tuple(kind) if kind else KINDS
    key = None if seed is None else jax.random.key(seed)
    rows: list[dict[str, Any]] = []
    with stages(transient=True) as show:
        for number, each in enumerate(kinds):
            show("certifying", number / len(kinds))
            rows += verdict_rows(problem, (each,), batch=batch, key=key)
    if as_json:
        print(json.dumps(rows, indent=2, allow_nan=False, ensure_ascii=False))
    else:
        _show(rows, title)
    if out is not None:
        from perfcontrol import results

        with in_words(f"write the verdicts to {out}"):
            results.save_json(rows, out)
    raise typer.Exit(0 if any(row["holds"] for row in rows) else 3)


def _show(rows: list[dict[str, Any]], title: str) -> None:
    columns = ("certificate", "applicable", "holds", "exists", "left", "right", "rate")
    table = Table(*columns, title=title)
    for row in rows:
        cells = [shown(row[key]) for key in ("applicable", "holds", "exists", "lhs", "rhs", "rate")]
        table.add_row(row["kind"], *cells)
    console.print(table)
    for row in rows:
        console.print(f"{row['kind']}: {row['text']}", highlight=False, markup=False)
