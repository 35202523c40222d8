"""What many runs share: single precision, and one step rule for all."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from perfcontrol.problem import PerformativeProblem


def in_single_precision(problem: PerformativeProblem) -> PerformativeProblem:
    """The problem with every floating-point array in float32."""
    return jax.tree.map(
        lambda leaf: jax.device_put(np.asarray(leaf, np.float32)) if eqx.is_inexact_array(leaf) else leaf, problem
    )


class StepRule(eqx.Module):
    """η_n = constant + phi1/(n + phi2): one compiled program for constant and diminishing steps."""

    constant: Any
    phi1: Any
    phi2: Any

    def __call__(self, n: Array) -> Array:
        return self.constant + self.phi1 / (n + self.phi2)
