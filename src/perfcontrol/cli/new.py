"""`perfcontrol new`."""

from pathlib import Path
from typing import Annotated

import typer

from perfcontrol.cli.app import app, console, in_words, refuse

TEMPLATES = {path.stem: path for path in sorted((Path(__file__).parent / "templates").glob("*.toml"))}


@app.command()
def new(
    path: Annotated[Path, typer.Argument(help="The file to write.")] = Path("problem.toml"),
    template: Annotated[str, typer.Option(help=f"What to begin with: {', '.join(TEMPLATES)}.")] = "reacting",
    force: Annotated[bool, typer.Option("--force", help="Overwrite a file of that name.")] = False,
) -> None:
    """Write a problem as a file with comments, which runs as it is: `perfcontrol solve problem.toml`."""
    if template not in TEMPLATES:
        raise refuse(f"--template: must be one of {', '.join(TEMPLATES)}; got {template!r}.")
    if path.suffix != ".toml":
        raise refuse(f"{path}: the name must end in .toml. Write {path.with_suffix('.toml')}.")
    if path.exists() and not force:
        raise refuse(f"{path} exists. Choose another name, or add --force.")
    from perfcontrol._files import written_whole

    with in_words(f"write {path}"), written_whole(path) as temporary:
        temporary.write_bytes(TEMPLATES[template].read_bytes())
    console.print(f"wrote {path}. Next: perfcontrol solve {path}", highlight=False, markup=False, soft_wrap=True)
