"""`perfcontrol reproduce`."""

import os
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.table import Table

from perfcontrol.cli.app import app, configure_jax, console, in_words, refuse
from perfcontrol.cli.progress import stages

_COLOURS = {"holds": "green", "holds as completed": "cyan", "does not hold": "yellow"}


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
        failures = []
        for problem in error.errors():
            name = str(problem["loc"][0]).replace("_", "-")
            failures.append(refuse(f"--{name}: {problem['msg']}; got {problem['input']!r}."))
        raise failures[0] from None
    # Before NumPy is there: on matrices of order 100, threads of the linear algebra wait for one another.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    configure_jax()
    from perfcontrol.experiments.reproduce import reproduce as run

    with stages() as show, in_words(f"write to {out}"):
        outcome = run(out, settings, show, fresh)
    table = Table("#", "claim", "statistic", "verdict", title="Claims of the paper's numerical section")
    for number, claim in enumerate(outcome.claims, 1):
        colour = _COLOURS[claim.verdict]
        table.add_row(str(number), claim.claim, f"{claim.value:.3g}", f"[{colour}]{claim.verdict}[/{colour}]")
    console.print(table)
    spent = ", ".join(f"{name} {value:.1f}" for name, value in outcome.seconds.items())
    console.print(f"{len(outcome.files)} files in {out}; {time.monotonic() - began:.1f} s ({spent}).")
