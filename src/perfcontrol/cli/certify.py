"""`perfcontrol certify`."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.table import Table

from perfcontrol.cli.app import app, configure_jax, console, in_words, refuse, shown


@app.command()
def certify(
    name: Annotated[Literal["stock"], typer.Argument(help="Built-in problem.")] = "stock",
    order: Annotated[
        Literal["ascending", "descending", "random"], typer.Option(help="Order of the sensitivities over time.")
    ] = "ascending",
    growth: Annotated[float, typer.Option(help="rho in A = rho I.")] = 1.0,
    feasible_set: Annotated[
        Literal["rows", "simplex"], typer.Option(help="Row sums, or nonnegative as well.")
    ] = "rows",
    batch: Annotated[int, typer.Option(help="Paths per step, for the safe step.", min=1)] = 1,
    kind: Annotated[
        list[str] | None, typer.Option(help="paper, rigorous, global or sharp; may be given again (all).")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Also write the verdicts to this JSON file.")] = None,
) -> None:
    """Say whether a stable policy exists, how fast it is reached, and which step is safe; and how each is known.

    The exit status is 0 if a certificate holds and 3 if none does.
    """
    configure_jax()
    from perfcontrol.experiments.stock import stock_market
    from perfcontrol.theory import KINDS, verdict_rows

    for given in kind or ():
        if given not in KINDS:
            raise refuse(f"--kind: must be one of {', '.join(KINDS)}; got {given!r}.")

    problem = stock_market(order, growth=growth, feasible_set=feasible_set)
    kinds = tuple(kind) if kind else KINDS
    with console.status("certifying"):
        rows = verdict_rows(problem, kinds, batch=batch)
    columns = ("certificate", "applicable", "holds", "exists", "left", "right", "rate")
    table = Table(*columns, title=f"{name}, {order}, {growth:g}")
    for row in rows:
        cells = [shown(row[key]) for key in ("applicable", "holds", "exists", "lhs", "rhs", "rate")]
        table.add_row(row["kind"], *cells)
    console.print(table)
    for row in rows:
        console.print(f"{row['kind']}: {row['text']}", highlight=False, markup=False)
    if out is not None:
        from perfcontrol import results

        with in_words(f"write the verdicts to {out}"):
            results.save_json(rows, out)
    raise typer.Exit(0 if any(row["holds"] for row in rows) else 3)
