"""A loop over time that takes one step of many paths at once, under vmap."""

from collections.abc import Callable
from typing import Any

import jax

from perfcontrol._side_by_side import side_by_side

Step = Callable[[Any, Any, Any], tuple[Any, Any]]  # fixed, carry, what varies in time -> carry, output


def time_loop(step: Step, fixed: Any, start: Any, steps: Any, together: bool, reverse: bool = False) -> Any:
    """The outputs of `step` along time, as of `jax.lax.scan`; whatever it works with is handed in.

    Args:
        step: (fixed, carry, one entry of `steps`) -> (carry, output).
        fixed: what stays the same in time.
        start: the first carry, an array.
        steps: what varies in time, with a leading axis.
        together: whether `step` also works on paths along a last axis (`side_by_side`).
        reverse: whether to run from the last entry to the first.
    """

    def loop(fixed: Any, start: Any, steps: Any) -> Any:
        return jax.lax.scan(lambda carry, entry: step(fixed, carry, entry), start, steps, reverse=reverse)[1]

    return (side_by_side(loop, carried=(1,)) if together else loop)(fixed, start, steps)
