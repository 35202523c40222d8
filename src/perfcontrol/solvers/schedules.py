"""When the current iterate is deployed, so that the world reacts to it."""

import equinox as eqx
from jaxtyping import Array

from perfcontrol._checks import check_integer


class Greedy(eqx.Module):
    """Deploy every iterate: the paper's Algorithm 1."""

    def deploys(self, n: Array) -> Array:
        """Whether the iterate of step n is deployed before its gradient is taken."""
        return n >= 0


class Lazy(eqx.Module):
    """Deploy every `steps`-th iterate and improve it meanwhile against the same world.

    Args:
        steps: gradient steps per deployment; 1 is greedy.
    """

    steps: int = eqx.field(static=True)

    def __init__(self, steps: int):
        self.steps = check_integer("steps", steps, 1)

    def deploys(self, n: Array) -> Array:
        """Whether the iterate of step n is deployed before its gradient is taken."""
        return n % self.steps == 0
