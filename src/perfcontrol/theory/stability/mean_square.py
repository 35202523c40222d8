"""Mean-square stability of repeated stochastic gradient descent near a stable policy, and the step it allows.

With 𝒥 the Jacobian of one sample gradient (law included), 𝒥̄ = E 𝒥, batch b and constant step η, the covariance of
M_n - M^PS follows, to first order,

    𝓛_η(X) = X - η(𝒥̄X + X𝒥̄ᵀ) + η² 𝓢(X),   𝓢(X) = E 𝒥X𝒥ᵀ / b + (1 - 1/b) 𝒥̄X𝒥̄ᵀ,   X_∞ = 𝓛_η(X_∞) + η² Cov(∇J)/b.

Threshold. Let 𝓨(X) = 𝒥̄X + X𝒥̄ᵀ with every eigenvalue of 𝒥̄ in the right half-plane, so that 𝓨⁻¹ is a positive map.
𝓛_η is positive, so its spectral radius is below 1 iff 𝓛_η(X) ≺ X for some X ≻ 0, that is 𝓨(X) ≻ η𝓢(X), which holds
for some X ≻ 0 iff the spectral radius of η𝓨⁻¹𝓢 is below 1. Hence every η below 1/ρ(𝓨⁻¹𝓢), and none above, is stable:
one eigenvalue problem instead of a search. Where an active constraint is curved, 𝓛_η carries the derivative of the
projection and the threshold is found by bisection on ρ(𝓛_η).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import scipy.linalg

from perfcontrol._checks import check_integer, fail
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.stability.sampled_jacobian import sample_jacobians

DEFAULT_SEED = 20241
Map = Callable[[np.ndarray], np.ndarray]


def leading_eigenvalue(operator: Map, size: int, tolerance: float = 1e-4, limit: int = 200) -> tuple[float, np.ndarray]:
    """Spectral radius of a positive map on symmetric matrices, with its positive semidefinite eigenvector."""
    X, value = np.eye(size) / size, 0.0
    for _ in range(limit):
        image = operator(X)
        following = float(np.trace(image))
        if following <= 0:
            return 0.0, X
        settled = abs(following - value) <= tolerance * following
        X, value = (image + image.T) / (2 * following), following
        if settled:
            break
    return value, X


@dataclass(frozen=True)
class MeanSquareStability:
    """Which constant steps keep RSGD stable near M^PS, and how far it then wanders.

    threshold_estimate: largest step that is stable in mean square; standard_error of it. mean_threshold: largest
    step for the mean of the iterates (exact; 0 where the mean field is unstable). All steps are on the gradient of
    the cost summed over stages. batch: paths a step.
    """

    threshold_estimate: float
    standard_error: float
    mean_threshold: float
    batch: int
    drift: np.ndarray
    sampled_square: Map  # X -> the sample mean of 𝒥X𝒥ᵀ
    gradient_covariance: np.ndarray
    damping: Callable[[float], np.ndarray] | None

    def _second(self, X: np.ndarray) -> np.ndarray:
        return _batched(self.sampled_square(X), self.drift @ X @ self.drift.T, self.batch)

    def operator(self, step: float) -> Map:
        """𝓛_η, from the samples."""
        P = None if self.damping is None else self.damping(step)

        def apply(X: np.ndarray) -> np.ndarray:
            linear = self.drift @ X
            image = X - step * (linear + linear.T) + step**2 * self._second(X)
            return image if P is None else P @ image @ P.T

        return apply

    def spectral_radius(self, step: float, tolerance: float = 1e-6) -> float:
        """ρ(𝓛_η) on the samples: the mean-square error is multiplied by it each step, in the long run."""
        return leading_eigenvalue(self.operator(step), len(self.drift), tolerance, 2000)[0]

    def stationary_covariance(self, step: float) -> np.ndarray:
        """X_∞ = 𝓛_η(X_∞) + η² Cov(∇J)/b, in coordinates of the tangent space; needs a stable step.

        Raises:
            InputError: the step is not below the threshold.
        """
        if not 0 < step < self.threshold_estimate:
            raise fail(
                "step",
                f"{step:.4g}",
                f"lie between 0 and the threshold {self.threshold_estimate:.4g}",
                "Pass a smaller step: above it the error has no stationary covariance.",
            )
        noise = step**2 * self.gradient_covariance / self.batch
        apply, X = self.operator(step), np.zeros_like(noise)
        if self.damping is None:  # X = 𝓨⁻¹(η𝓢(X) + noise/η) contracts at the rate step/threshold

            def following(X: np.ndarray) -> np.ndarray:
                return _lyapunov(self.drift, step * self._second(X) + noise / step)
        else:

            def following(X: np.ndarray) -> np.ndarray:
                return apply(X) + noise

        for _ in range(5000):
            image = following(X)
            change = np.abs(image - X).max()
            X = image
            if change <= 1e-6 * np.abs(X).max():
                break
        return X

    def error_floor(self, step: float) -> float:
        """E ‖M_n - M^PS‖²_F in the long run at that step, to first order."""
        return float(np.trace(self.stationary_covariance(step)))


def _batched(sampled: np.ndarray, mean_part: np.ndarray, batch: int) -> np.ndarray:
    return sampled / batch + (1 - 1 / batch) * mean_part


def _lyapunov(drift: np.ndarray, right: np.ndarray) -> np.ndarray:
    """X with drift X + X driftᵀ = right."""
    X = scipy.linalg.solve_continuous_lyapunov(drift, right)
    return (X + X.T) / 2


def mean_field_threshold(drift: np.ndarray) -> float:
    """Largest η with ρ(I - η drift) ≤ 1: min 2 Re λ/|λ|², or 0 where some Re λ ≤ 0."""
    values = np.linalg.eigvals(drift)
    if len(values) == 0:
        return np.inf
    return float(max(np.min(2 * values.real / np.abs(values) ** 2), 0.0)) if np.all(values.real > 0) else 0.0


def stability_at(
    problem: PerformativeProblem,
    M: Any,
    drift: np.ndarray,
    basis: np.ndarray,
    *,
    batch: int = 1,
    samples: int = 1024,
    key: Any = None,
    damping: Callable[[float], np.ndarray] | None = None,
    mean_threshold: float | None = None,
) -> MeanSquareStability:
    """The mean-square analysis at a policy M.

    Args:
        M: the stable policy (free parameters). drift: 𝒥̄ = basisᵀ(𝐇+𝐄)basis, (q, q). basis: (p, q), of the tangent
        space. batch: paths a step. samples: how many Jacobians are drawn; half of them find the eigenvectors, on
        the other half the eigenvalue is measured, and the other way round. key: JAX random key, a fixed one if None.
        damping: step -> derivative of the projection in the tangent space, for curved constraints.
    """
    batch, samples = check_integer("batch", batch, 1), check_integer("samples", samples, 8)
    key = jax.random.key(DEFAULT_SEED) if key is None else key
    halves, gradients = sample_jacobians(problem, M, basis, key, samples)
    covariance = np.atleast_2d(np.cov(gradients, rowvar=False))
    mean_threshold = mean_field_threshold(drift) if mean_threshold is None else mean_threshold

    def joined(X: np.ndarray) -> np.ndarray:
        return (halves[0].mean_square(X) + halves[1].mean_square(X)) / 2

    def result(threshold: float, error: float, square: Map = joined) -> MeanSquareStability:
        return MeanSquareStability(threshold, error, mean_threshold, batch, drift, square, covariance, damping)

    q = len(drift)
    if q == 0 or mean_threshold == 0:
        return result(np.inf if q == 0 else 0.0, 0.0)
    if damping is not None:
        return _bisected(result, [half.mean_square for half in halves], mean_threshold)
    radii = []
    for fitted, fresh in (halves, halves[::-1]):

        def forward(X: np.ndarray, fitted: Any = fitted) -> np.ndarray:
            return _lyapunov(drift, _batched(fitted.mean_square(X), drift @ X @ drift.T, batch))

        def backward(Y: np.ndarray, fitted: Any = fitted) -> np.ndarray:
            L = _lyapunov(drift.T, Y)
            return _batched(fitted.adjoint(L), drift.T @ L @ drift, batch)

        _, X = leading_eigenvalue(forward, q, 1e-3, 40)
        _, Y = leading_eigenvalue(backward, q, 1e-3, 40)
        L = _lyapunov(drift.T, Y)
        scale = float(np.sum(Y * X))
        mean_part = (1 - 1 / batch) * float(np.sum(L * (drift @ X @ drift.T)))
        radii.append((fresh.values(L, X) / batch + mean_part) / scale)
    values = np.concatenate(radii)
    radius = float(np.mean(values))
    error = float(np.std(values, ddof=1)) / np.sqrt(len(values)) / radius
    return result(min(1 / radius, mean_threshold), error / radius)


def _bisected(result: Callable[..., MeanSquareStability], squares: list[Map], high: float) -> MeanSquareStability:
    """The threshold by bisection on ρ(𝓛_η); its spread over the two halves of the samples as the error."""

    def threshold(stability: MeanSquareStability) -> float:
        low, top = 0.0, high
        for _ in range(30):
            middle = (low + top) / 2
            low, top = (middle, top) if stability.spectral_radius(middle, 1e-5) < 1 else (low, middle)
        return low

    spread = [threshold(result(high, 0.0, square)) for square in squares]
    return result(threshold(result(high, 0.0)), abs(spread[0] - spread[1]) / 2)
