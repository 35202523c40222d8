"""`python -m perfcontrol` is the `perfcontrol` command."""

from perfcontrol.cli import main

if __name__ == "__main__":
    main()
