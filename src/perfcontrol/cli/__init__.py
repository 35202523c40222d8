"""The command line, one file a command. It alone sets JAX's global configuration."""

from perfcontrol.cli import certify, new, report, reproduce, solve, stocks  # noqa: F401 - each adds its command
from perfcontrol.cli.app import app

__all__ = ["app", "main"]


def main() -> None:
    """Entry point of the `perfcontrol` command."""
    app()
