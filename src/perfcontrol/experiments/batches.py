"""What many runs share: single precision, one step rule for all, exact costs of every iterate."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._programs import program
from perfcontrol.evaluate.exact import exact_cost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.rows import on_devices, pick

COST_LANES = 32  # policies worked on together on one device: they stay in cache
COST_ROUNDS = 32  # times COST_LANES: policies a device costs in one compiled call
CEILING = 1e30  # costs of runaway policies are astronomical: recorded as this


def in_single_precision(problem: PerformativeProblem) -> PerformativeProblem:
    """The problem with every floating-point array in float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, problem)


class StepRule(eqx.Module):
    """η_n = constant + phi1/(n + phi2): one compiled program for constant and diminishing steps."""

    constant: Any
    phi1: Any
    phi2: Any

    def __call__(self, n: Array) -> Array:
        return self.constant + self.phi1 / (n + self.phi2)


@program
def _costed(problems: PerformativeProblem, case: Any, M: Any) -> Any:
    def one(problems: PerformativeProblem, row: Any) -> Array:
        case, M = row
        return exact_cost(pick(problems, case), M, M)

    return on_devices(one, COST_LANES, problems, (case, M))


def costs(problems: PerformativeProblem, policies: np.ndarray, steps_taken: np.ndarray) -> np.ndarray:
    """Exact C_T(M; M) of every iterate of runs, (cases, seeds, steps+1), `CEILING` where it is larger or overflows.

    Policies past the step at which a run ended repeat its last one: their cost is not computed again.
    """
    shape = policies.shape[:3]
    last = np.minimum(np.arange(shape[2]), steps_taken[..., None])
    fresh = np.flatnonzero(np.arange(shape[2]) == last)
    case = np.arange(math.prod(shape)) // (shape[1] * shape[2])
    policies = policies.reshape(-1, *policies.shape[3:])
    values = np.empty(len(policies))
    together = COST_LANES * COST_ROUNDS * len(jax.local_devices())
    for first in range(0, len(fresh), together):
        part = fresh[first : first + together]
        filled = np.resize(part, together)  # the last part repeats itself: one compiled shape for all
        values[part] = _costed(problems, case[filled], policies[filled])[: len(part)]
    spread = np.take_along_axis(values.reshape(shape), last, axis=2)
    return np.where(spread < CEILING, spread, CEILING)  # False for what is not finite
