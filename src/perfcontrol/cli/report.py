"""`perfcontrol report`."""

from pathlib import Path
from typing import Annotated

import typer

from perfcontrol.cli.app import app, configure_jax, console, in_words
from perfcontrol.cli.plans import AsJson, File, Seed, plan_in
from perfcontrol.cli.progress import stages


@app.command()
def report(
    file: File = Path("problem.toml"),
    out: Annotated[
        Path | None, typer.Option(help="File to write (report.html in the folder of the run, or here).")
    ] = None,
    samples: Annotated[int, typer.Option(help="Simulated paths of each policy.", min=2)] = 1024,
    seconds: Annotated[
        float | None, typer.Option(help="Begin no new part after so long; what is left out is named.", min=0.0)
    ] = None,
    title: Annotated[str | None, typer.Option(help="Of the page (the name of the file or folder).")] = None,
    seed: Seed = None,
    as_json: AsJson = False,
) -> None:
    """Write one page about a problem or a run: one HTML file that needs no network.

    Does a stable policy exist and how is that known, what do naive, stable and optimal policy cost, how do methods get
    there, what do states, inputs and costs do.
    """
    configure_jax()
    from perfcontrol.files.run import read_run
    from perfcontrol.reports import report as make

    with in_words(f"read {file}"):
        subject = read_run(file) if file.is_dir() else plan_in(file, seed=seed)
    if not file.is_dir() and seed is None:
        seed = subject.seed
    target = out or (file / "report.html" if file.is_dir() else Path("report.html"))
    name = file.resolve().name
    with stages(transient=True) as show, in_words(f"write {target}"):
        made = make(
            subject if file.is_dir() else subject.problem,
            path=target,
            title=title or f"Performative control: {name}",
            seed=seed,
            samples=samples,
            seconds=seconds,
            progress=show,
        )
    if as_json:
        import json

        print(json.dumps({"file": str(target), "missing": made.missing, "seconds": made.seconds}, indent=2))
        return
    for part, reason in made.missing.items():
        console.print(f"not shown: {part}: {reason}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"wrote {target}", highlight=False, markup=False, soft_wrap=True)
