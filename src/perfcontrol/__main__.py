"""The `perfcontrol` command, also as `python -m perfcontrol`."""

import sys


def main() -> None:
    """Run the command line, or say what it lacks."""
    try:
        from perfcontrol.cli import main as command
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "perfcontrol":
            raise
        sys.exit(f"error: the command line needs {error.name}. Install it with pip install 'perfcontrol[app]'.")
    command()


if __name__ == "__main__":
    main()
