"""Which policy to deploy next: the one that adds most to what is known of the reaction and of B.

Deployments are points of a design for a reaction that is affine in M and in ‖M‖, f(M) = (1, M, ‖M‖), with
Λ = Σ_g N_g f fᵀ so far; and they move the inputs by E v vᵀ = Σ_i M_i Cov(w) M_iᵀ beside the feedback. A policy adds
log(1 + N fᵀ Λ⁻¹ f) + log det(I + N Γ⁻¹ E v vᵀ), Γ = Σ v vᵀ so far: the gain in the information's log determinant.
"""

from typing import Any

import numpy as np

from perfcontrol._checks import fail
from perfcontrol.identification.common import Common
from perfcontrol.identification.transitions import Transitions

TRIALS = 256
PRIOR = 1e-2  # of one deployment's information: what is taken as known of every direction beforehand


def next_policy(
    data: Transitions, common: Common, candidates: Any, radius: float | None, generator: np.random.Generator
) -> np.ndarray:
    """The best of the candidates (memory, m, n), or of policies within `radius` of the last one deployed."""
    last = data.policies[data.group[-1]]
    if candidates is not None:
        tried = _checked(candidates, last.shape)
    else:
        reach = _radius(data, common, radius)
        tried = last + reach * _unit_steps(data, generator)
    return tried[int(np.argmax(_gains(data, common, tried)))]


def _checked(candidates: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(candidates, dtype=float)
    if array.ndim != 4 or array.shape[1:] != shape or len(array) == 0 or not np.all(np.isfinite(array)):
        required = f"be finite policies of shape {shape}, stacked"
        raise fail("candidates", f"{array.shape}", required, "Pass a single one as [M].")
    return array


def _radius(data: Transitions, common: Common, radius: float | None) -> float:
    if radius is not None:
        if not (isinstance(radius, int | float) and 0 < radius < np.inf):
            raise fail("radius", repr(radius), "be a positive number", "Pass None for the spread of those deployed.")
        return float(radius)
    flat = data.policies.reshape(len(data.policies), -1)
    spread = float(np.linalg.norm(flat[:, None] - flat[None], axis=2).max())
    size = float(np.linalg.norm(flat, axis=1).max())
    if max(spread, size) > 0:
        return max(spread, 0.5 * size)
    feedback = np.sqrt(np.mean((data.x @ data.gain.T) ** 2)) if data.gain.any() else 0.0
    noise = np.sqrt(np.mean(np.sum(common.root**2, axis=1)))
    return float(feedback / noise) if feedback > 0 else 1.0  # inputs as large as those of the feedback


def _unit_steps(data: Transitions, generator: np.random.Generator) -> np.ndarray:
    """Directions of norm one: along what was tried least, and at random."""
    flat = data.policies.reshape(len(data.policies), -1)
    _, _, axes = np.linalg.svd(flat - flat[data.group[-1]], full_matrices=True)
    random = generator.standard_normal((TRIALS, flat.shape[1]))
    steps = np.concatenate([axes, -axes, random])
    return (steps / np.linalg.norm(steps, axis=1, keepdims=True)).reshape(-1, *data.policies.shape[1:])


def _gains(data: Transitions, common: Common, tried: np.ndarray) -> np.ndarray:
    """What each of some policies (k, memory, m, n) adds, (k,)."""
    counts = np.bincount(data.row_group, minlength=len(data.policies))
    each = counts.mean()
    largest = np.sqrt(np.sum(data.policies**2, axis=(1, 2, 3)).max())
    scale = np.maximum(np.maximum(np.sqrt(np.sum(tried**2, axis=(1, 2, 3))), largest), 1e-300)
    features = _features(data.policies / scale[:, None, None, None, None])
    f = _features(tried / scale[:, None, None, None])
    known = np.swapaxes(features, 1, 2) @ (counts[:, None] * features) + PRIOR * each * np.eye(f.shape[1])
    reaction = np.log1p(each * np.einsum("kf,kf->k", f, np.linalg.solve(known, f[:, :, None])[..., 0]))
    through = tried @ common.root
    moved = np.einsum("kimn,kijn->kmj", through, through)
    size = np.maximum(np.trace(moved, axis1=1, axis2=2), max(float(np.sum(data.v**2)) / len(data.v), 1e-300))
    eye, size = np.eye(moved.shape[1]), size[:, None, None]
    before = data.v.T @ data.v / size + PRIOR * each * eye
    return reaction + np.linalg.slogdet(eye + each * np.linalg.solve(before, moved / size))[1]


def _features(policies: np.ndarray) -> np.ndarray:
    """(1, M, ‖M‖) of policies (..., memory, m, n)."""
    flat = policies.reshape(*policies.shape[:-3], -1)
    ones, norm = np.ones((*flat.shape[:-1], 1)), np.linalg.norm(flat, axis=-1, keepdims=True)
    return np.concatenate([ones, flat, norm], axis=-1)
