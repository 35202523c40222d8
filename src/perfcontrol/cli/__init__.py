"""The command line, one file a command. It alone sets JAX's global configuration."""

import gc

from perfcontrol.cli import (  # noqa: F401 - each adds its command
    certify,
    compare,
    new,
    report,
    reproduce,
    resume,
    schema,
    simulate,
    solve,
    stocks,
    sweep,
)
from perfcontrol.cli.app import app

__all__ = ["app", "main"]


def main() -> None:
    """Entry point of the `perfcontrol` command."""
    # Modules and compiled programs stay: to look through them for garbage every 700 objects takes a tenth of the time.
    gc.set_threshold(100_000)
    app()
