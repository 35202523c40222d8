"""The command line. It alone sets JAX's global configuration: float64, and one host device per core."""

import contextlib
import os
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
console = Console()
errors = Console(stderr=True)
_COLOURS = {"holds": "green", "holds as completed": "cyan", "does not hold": "yellow"}


@app.callback()
def _root() -> None:
    """Performative control of linear dynamical systems."""


def _configure_jax() -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        with contextlib.suppress(RuntimeError):  # JAX runs already, called from a program of its own: keep its devices
            jax.config.update("jax_num_cpu_devices", cores)


@app.command()
def reproduce(
    out: Annotated[Path, typer.Option(help="Folder for figures, tables and data.")] = Path("results/paper"),
    seeds: Annotated[int | None, typer.Option(help="Independent runs of each case (32).", min=2)] = None,
    steps: Annotated[int | None, typer.Option(help="Iterations of each run (1000).", min=100)] = None,
    step_size: Annotated[
        float | None, typer.Option(help="Constant step on the stage average of the gradient (0.01).")
    ] = None,
    feasible_set: Annotated[
        Literal["rows", "simplex"] | None, typer.Option(help="Row sums alone, or nonnegative as well (rows).")
    ] = None,
    initial_investment: Annotated[float | None, typer.Option(help="q_1 of every stock (150).")] = None,
    rate: Annotated[float | None, typer.Option(help="Riskless rate (0.05).")] = None,
    trading_hours: Annotated[float | None, typer.Option(help="Trading hours a day (6.5).")] = None,
    seed: Annotated[int | None, typer.Option(help="Root of all randomness (0).", min=0)] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A small run that ends within seconds.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Ignore the stages already in OUT.")] = False,
) -> None:
    """Reproduce the paper's experiment: three figures, the data, and a verdict on each of its claims.

    A run that was stopped resumes with the stages that it had finished.
    """
    began = time.monotonic()
    from pydantic import ValidationError

    from perfcontrol.config import ReproduceSettings

    given: dict[str, Any] = {
        name: value
        for name, value in {
            "seeds": seeds,
            "steps": steps,
            "step_size": step_size,
            "feasible_set": feasible_set,
            "initial_investment": initial_investment,
            "rate": rate,
            "trading_hours": trading_hours,
            "seed": seed,
        }.items()
        if value is not None
    }
    base = ReproduceSettings.quick() if quick else ReproduceSettings()  # type: ignore[call-arg]
    try:
        settings = ReproduceSettings(**{**base.model_dump(), **given})
    except ValidationError as error:
        for problem in error.errors():
            name = str(problem["loc"][0]).replace("_", "-")
            errors.print(f"error: --{name}: {problem['msg']}; got {problem['input']!r}.", style="red")
        raise typer.Exit(2) from None
    _configure_jax()
    from perfcontrol.experiments.reproduce import reproduce as run

    with Progress(
        TextColumn("{task.description:<26}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%"), TimeElapsedColumn(),
        console=errors,
    ) as bars:  # fmt: skip
        tasks: dict[str, Any] = {}

        def show(stage: str, share: float) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=1.0)
            bars.update(tasks[stage], completed=min(share, 1.0))

        try:
            outcome = run(out, settings, show, fresh)
        except OSError as error:
            errors.print(f"error: cannot write to {out}: {error}", style="red")
            raise typer.Exit(1) from None
    table = Table("#", "claim", "statistic", "verdict", title="Claims of the paper's numerical section")
    for number, claim in enumerate(outcome.claims, 1):
        colour = _COLOURS[claim.verdict]
        table.add_row(str(number), claim.claim, f"{claim.value:.3g}", f"[{colour}]{claim.verdict}[/{colour}]")
    console.print(table)
    spent = ", ".join(f"{name} {value:.1f}" for name, value in outcome.seconds.items())
    console.print(f"{len(outcome.files)} files in {out}; {time.monotonic() - began:.1f} s ({spent}).")


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
    _configure_jax()
    from perfcontrol.experiments.stock import stock_market
    from perfcontrol.theory import KINDS, verdict_rows

    for given in kind or ():
        if given not in KINDS:
            errors.print(f"error: --kind: must be one of {', '.join(KINDS)}; got {given!r}.", style="red")
            raise typer.Exit(2)

    problem = stock_market(order, growth=growth, feasible_set=feasible_set)
    kinds = tuple(kind) if kind else KINDS
    with console.status("certifying"):
        rows = verdict_rows(problem, kinds, batch=batch)
    columns = ("certificate", "applicable", "holds", "exists", "left", "right", "rate")
    table = Table(*columns, title=f"{name}, {order}, {growth:g}")
    for row in rows:
        shown = [_shown(row[key]) for key in ("applicable", "holds", "exists", "lhs", "rhs", "rate")]
        table.add_row(row["kind"], *shown)
    console.print(table)
    for row in rows:
        console.print(f"{row['kind']}: {row['text']}", highlight=False, markup=False)
    if out is not None:
        from perfcontrol import results

        try:
            results.save_json(rows, out)
        except OSError as error:
            errors.print(f"error: cannot write to {out}: {error}", style="red")
            raise typer.Exit(1) from None
    raise typer.Exit(0 if any(row["holds"] for row in rows) else 3)


def _shown(value: Any) -> str:
    """A table cell."""
    if value is None:
        return "unknown"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if isinstance(value, str) else f"{value:.3g}"


def main() -> None:
    """Entry point of the `perfcontrol` command."""
    app()


if __name__ == "__main__":
    main()
