"""Progress of a long command, a bar a stage."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from perfcontrol.cli.app import errors


@contextlib.contextmanager
def stages(transient: bool = False) -> Iterator[Callable[[str, float], None]]:
    """A function of a stage's name and the share of it that is done; `transient` bars vanish at the end."""
    with Progress(
        TextColumn("{task.description:<26}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%"), TimeElapsedColumn(),
        console=errors, transient=transient,
    ) as bars:  # fmt: skip
        tasks: dict[str, Any] = {}

        def show(stage: str, share: float) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=1.0)
            bars.update(tasks[stage], completed=min(share, 1.0))

        yield show
