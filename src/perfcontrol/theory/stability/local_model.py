"""The first-order model of the methods at a stable policy.

RRM: the derivative of the best response, Φ' = -𝐇⁻¹𝐄 (on the tangent space where constraints are active, with the
curvature of the constraint). RRM converges locally if its spectral radius is below 1, does not if it is above, and
nothing follows at 1. RSGD: the mean field is stable iff every eigenvalue of 𝐇+𝐄 has positive real part; its largest
step, and that of the stochastic method in mean square, are in `mean_square`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from perfcontrol.evaluate.exact import exact_gradient
from perfcontrol.evaluate.reaction import reaction_jacobian
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.derivatives import hessian, projection_derivative, range_basis
from perfcontrol.theory.precision import in_double
from perfcontrol.theory.stability.mean_square import mean_field_threshold


class LocalModel(NamedTuple):
    """First-order model of RRM and RSGD at a stable policy M.

    response_jacobian: Φ' = answer 𝐄 on the tangent space, (q, q). drift: 𝐇+𝐄 there, (q, q). basis: (p, q). answer: how
    Φ answers a change of the gradient, (q, q); -𝐇⁻¹ where constraints are flat. damping: step -> derivative of the
    projection on the tangent space, or None where that is the identity (flat constraints).
    """

    M: np.ndarray
    response_jacobian: np.ndarray
    drift: np.ndarray
    basis: np.ndarray
    answer: np.ndarray
    damping: Callable[[float], np.ndarray] | None


@in_double
def local_model(problem: PerformativeProblem, M: Any) -> LocalModel:
    """The model at a stable policy M (free parameters)."""
    M = np.asarray(M)
    H, E = hessian(problem, M), reaction_jacobian(problem, M, M).astype(float)
    gradient = np.asarray(exact_gradient(problem, M, M), dtype=float)
    small = 0.1 / max(float(np.linalg.norm(H, 2)), np.finfo(float).tiny)
    slope = projection_derivative(problem, M - small * gradient)
    basis = range_basis(slope)
    H, E = basis.T @ H @ basis, basis.T @ E @ basis
    slope, eye = basis.T @ slope @ basis, np.eye(basis.shape[1])
    # Φ(M') = Proj(Φ - η g(Φ; M')), differentiated in the tangent space; without curvature this is -H⁻¹E.
    system = eye - slope + small * slope @ H
    answer = np.linalg.lstsq(system, -small * slope, rcond=1e-13)[0] if basis.size else np.zeros((0, 0))
    damping: Callable[[float], np.ndarray] | None = None
    if basis.size and np.abs(slope - eye).max() > 1e-6:

        def curved(step: float) -> np.ndarray:
            return basis.T @ projection_derivative(problem, M - step * gradient) @ basis

        damping = curved

    return LocalModel(M, answer @ E, H + E, basis, answer, damping)


def spectral_radius(matrix: np.ndarray) -> float:
    """Largest modulus of an eigenvalue; 0 for an empty matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def largest_mean_step(model: LocalModel) -> float:
    """Largest constant step at which repeated gradient descent is stable; 0 if it is for none."""
    if model.damping is None:
        return mean_field_threshold(model.drift)
    eye = np.eye(len(model.drift))

    def radius(step: float) -> float:
        assert model.damping is not None
        return spectral_radius(model.damping(step) @ (eye - step * model.drift))

    scale = 1 / max(float(np.linalg.norm(model.drift, 2)), np.finfo(float).tiny)
    if radius(1e-4 * scale) >= 1:
        return 0.0
    low, high = 1e-4 * scale, 2 * scale
    while radius(high) < 1 and high < 1e6 * scale:
        low, high = high, 2 * high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < 1 else (low, middle)
    return low
