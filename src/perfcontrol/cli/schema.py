"""`perfcontrol schema`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from perfcontrol.cli.app import app, console, in_words


@app.command()
def schema(
    out: Annotated[Path | None, typer.Option(help="Write it to this file; printed unless given.")] = None,
) -> None:
    """The JSON schema of problem files: editors complete and check keys with it.

    Begin a problem file with the line `#:schema ./problem.schema.json` where an editor knows that comment.
    """
    from perfcontrol.files.schema import schema as made

    text = json.dumps(made(), indent=1, ensure_ascii=False) + "\n"
    if out is None:
        print(text, end="")
        return
    from perfcontrol.results import save_text

    with in_words(f"write {out}"):
        save_text(text, out)
    console.print(f"wrote {out}", highlight=False, markup=False)
