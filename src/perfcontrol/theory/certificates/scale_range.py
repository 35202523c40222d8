"""The range of the scales of fixed directions over the feasible set."""

from typing import Any, NamedTuple

import jax
import numpy as np

from perfcontrol._checks import as_array, fail
from perfcontrol.perturbations import DirectionalPerturbation
from perfcontrol.policy_maps import AbstractPolicyMap, Affine
from perfcontrol.problem import PerformativeProblem


class ScaleRange(NamedTuple):
    """σ_{tk} ∈ [low, high] over the set, (T, k); slopes: (T, k, p) in the free parameters where affine, else None;
    lipschitz: (T, k) of σ in ‖·‖_F of the free parameters."""

    low: np.ndarray
    high: np.ndarray
    slopes: np.ndarray | None
    lipschitz: np.ndarray


def scale_range(problem: PerformativeProblem, declared: Any = None) -> ScaleRange | str:
    """The range of the scales over the feasible set, or why it is not known."""
    law = problem.perturbation
    assert isinstance(law, DirectionalPerturbation)
    shape = (problem.horizon, law.directions.shape[0])
    size = int(np.prod(problem.policy_shape))

    def full(value: Any) -> np.ndarray:
        return np.broadcast_to(np.asarray(value, dtype=float), shape)

    if declared is not None:
        low, high, lipschitz = (full(as_array("scale_range", part)) for part in declared)
        if np.any(low > high) or np.any(lipschitz < 0):
            raise fail("scale_range", "low > high or a negative Lipschitz constant", "be ordered", "Check the order.")
        return ScaleRange(low, high, None, lipschitz)
    if not isinstance(law.scale, AbstractPolicyMap):
        return ScaleRange(full(law.scale), full(law.scale), np.zeros((*shape, size)), np.zeros(shape))
    if not isinstance(law.scale, Affine):
        return "the scales are a general function: declare scale_range=(low, high, Lipschitz constant)"
    flat = law.scale.slope.reshape(-1, *problem.lifted_shape)
    upper, lower = problem.lifted_set.support(flat), problem.lifted_set.support(-flat)
    if upper is None or lower is None:
        return "the scales are not known to be bounded on this feasible set: declare scale_range, or bound the set"
    offset = np.asarray(law.scale.offset, dtype=float)
    low = full(offset - np.asarray(lower, dtype=float).reshape(offset.shape))
    high = full(offset + np.asarray(upper, dtype=float).reshape(offset.shape))
    slopes = np.asarray(jax.vmap(problem.structure.adjoint)(flat), dtype=float).reshape(*offset.shape, size)
    slopes = np.broadcast_to(slopes, (*shape, size))
    return ScaleRange(low, high, slopes, np.linalg.norm(slopes, axis=-1))
