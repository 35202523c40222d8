"""The range of the scales of fixed directions over the feasible set."""

from typing import Any, NamedTuple

import numpy as np

from perfcontrol._checks import as_array, fail
from perfcontrol.perturbations import DirectionalPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.facts import in_free_parameters, read

DECLARE = "declare (low, high, Lipschitz constant) over the set by scale_range=(0.0, 1.0, 0.5)"
GENERAL = (
    "the scales are a general function: pass scale=pc.Affine(offset, slope) or scale=pc.Norm(offset, weight) if they "
    f"are affine or go by the norm, or {DECLARE}"
)
UNBOUNDED = (
    "the scales are not known to be bounded on this feasible set: pass a bounded one, such as "
    f"feasible_set=pc.FrobeniusBall(1.0), or {DECLARE}"
)


class ScaleRange(NamedTuple):
    """σ_{tk} ∈ [low, high] over the set, (T, k); slopes: (T, k, p) in the free parameters where affine, else None;
    lipschitz: (T, k) of σ in ‖·‖_F of the free parameters."""

    low: np.ndarray
    high: np.ndarray
    slopes: np.ndarray | None
    lipschitz: np.ndarray


@read
def _known(problem: PerformativeProblem) -> tuple[Any, Any, Any]:
    """Range, Lipschitz constants and derivative of the scales, each None where the map does not know it."""
    law = problem.perturbation
    assert isinstance(law, DirectionalPerturbation)
    return law.scale.range(problem.lifted_set), law.scale.lipschitz(problem.lifted_set), law.scale.derivative()


def scale_range(problem: PerformativeProblem, declared: Any = None) -> ScaleRange | str:
    """The range of the scales over the feasible set, or why it is not known."""
    law = problem.perturbation
    assert isinstance(law, DirectionalPerturbation)
    shape = (problem.horizon, law.directions.shape[0])

    def full(value: Any) -> np.ndarray:
        try:
            return np.broadcast_to(np.asarray(value, dtype=float), shape)
        except ValueError:
            required = f"hold numbers, or arrays that broadcast to (T, k) = {shape}"
            raise fail("scale_range", f"shape {np.shape(value)}", required, "Put the time axis first.") from None

    if declared is not None:
        if not isinstance(declared, tuple | list) or len(declared) != 3:
            required = "be three: (low, high, Lipschitz constant)"
            raise fail("scale_range", repr(declared), required, "Pass for example scale_range=(0.0, 1.0, 0.5).")
        low, high, lipschitz = (full(as_array("scale_range", part)) for part in declared)
        if np.any(low > high) or np.any(lipschitz < 0):
            raise fail(
                "scale_range",
                "low > high or a negative Lipschitz constant",
                "be ordered",
                "Pass (low, high, Lipschitz constant), for example (0.0, 1.0, 0.5).",
            )
        return ScaleRange(low, high, None, lipschitz)
    bounds, lipschitz, derivative = _known(problem)
    if bounds is None or lipschitz is None:
        return UNBOUNDED if law.scale.continuous else GENERAL
    low, high = full(bounds[0]), full(bounds[1])
    if derivative is None:
        return ScaleRange(low, high, None, full(lipschitz) * problem.structure.norm)
    slopes = in_free_parameters(problem, derivative).astype(float)
    slopes = np.broadcast_to(slopes, (*shape, slopes.shape[-1]))
    return ScaleRange(low, high, slopes, np.linalg.norm(slopes, axis=-1))
