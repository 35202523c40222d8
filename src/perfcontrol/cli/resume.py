"""`perfcontrol resume`."""

from pathlib import Path
from typing import Annotated

import typer

from perfcontrol.cli.app import app, configure_jax, console, in_words
from perfcontrol.cli.plans import AsJson
from perfcontrol.cli.solve import carry_out
from perfcontrol.cli.sweep import fill


@app.command()
def resume(
    run: Annotated[Path, typer.Argument(help="Folder that `solve --out` or `sweep --out` has begun.")],
    as_json: AsJson = False,
) -> None:
    """Go on with a run or a sweep that was stopped, from where it was kept last; a finished one is left as it is."""
    configure_jax()
    from perfcontrol._lock import locked
    from perfcontrol.files.building import read_plan
    from perfcontrol.files.run import PROBLEM, read_record

    with in_words(f"go on with {run}"):
        record = read_record(run)
        with locked("run", run):
            record = read_record(run)
            if record["kind"] == "sweep":
                fill(run, record, as_json)
            elif record["ended"]:
                console.print(f"{run} has ended: {record['result']}", highlight=False, markup=False, soft_wrap=True)
            else:
                carry_out(read_plan(run / PROBLEM), run, record["certify"], as_json)
