"""The global certificate: a proved modulus of contraction of Φ over the whole set, for quadratic costs and fixed
directions. No strong stability and no bounded noise is needed.

With Δ_t = Θ_t + Σ_k σ_{tk}(M') ζ_{tk} D_k and θ = σ², the cost in coordinates y of the set is [1; y]ᵀ𝔾(θ)[1; y] where
𝔾 is a polynomial in θ with positive semidefinite coefficients (every path of the expansion in ζ is a square). So on
[θ_lo, θ_hi] it increases, and |𝔾(θ') - 𝔾(θ)| ⪯ N(M - M') 𝔏 in every direction, 𝔏 the derivative of 𝔾 at θ_hi along
ℓ, where |θ_{tk}(M) - θ_{tk}(M')| ≤ ℓ_{tk} N(M - M') in the norm N(y)² = yᵀGy, G the y-block of 𝔾(θ_lo). With
ϱ = λ_max(𝔏_yy, G) and h ≥ [1; y]ᵀ𝔏[1; y] at every best response,

    N(Φ(M) - Φ(M')) ≤ √(ϱ h) N(M - M').

References: docs, theory, "The global certificate".
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.linalg

from perfcontrol.perturbations import DirectionalPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption, word_of
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.ingredients import FIXED_NOISE
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.certificates.quadratic_form import expansion, expansions, simplified
from perfcontrol.theory.certificates.scale_range import ScaleRange, scale_range
from perfcontrol.theory.derivatives import obstacles, tangent_basis
from perfcontrol.theory.existence import constant_mean, existence


@dataclass(frozen=True, kw_only=True)
class GlobalBound(AbstractCertificateKind):
    """A modulus of contraction of Φ in the norm N, for quadratic costs and perturbations along fixed directions.

    Args:
        scale_range: (low, high, Lipschitz constant) of the scales over the set, each broadcast to (T, k), for scales
            that are a general function or a set on which they are not known to be bounded.

    Raises:
        InputError: (in `pc.certify`) a range that is not in order, or of a wrong shape.

    References:
        docs: theory, "The global certificate".
    """

    scale_range: tuple[Any, Any, Any] | None = None

    name: ClassVar[str] = "global"
    title: ClassVar[str] = "The global contraction bound"

    def assess(self, problem: PerformativeProblem) -> Certificate:
        exists, missing = existence(problem), _missing(problem)
        ranges = None if missing else scale_range(problem, self.scale_range)
        if isinstance(ranges, str):
            missing.append(ranges)
        if not isinstance(ranges, ScaleRange):
            return self.refuse(missing, exists)
        assumptions = [Assumption("the modulus of contraction", "proved"), *word_of(problem)]
        if self.scale_range is not None:
            assumptions.append(Assumption("the range of the scales", "declared"))
        modulus, values, note = _modulus(problem, ranges)
        notes = (note,) if note else ()
        return self.conclude(modulus, 1.0, exists, tuple(assumptions), values=values, notes=notes)


def _missing(problem: PerformativeProblem) -> list[str]:
    missing = obstacles(problem)
    if not isinstance(problem.perturbation, DirectionalPerturbation):
        wanted = "perturbation=pc.DirectionalPerturbation(directions, pc.Affine(offset, slope))"
        missing.append(f"the perturbations are not of fixed directions: pass {wanted}, or use pc.Sharp()")
    elif not constant_mean(problem):
        missing.append("the mean of the perturbations depends on the policy: pass mean=None, or use pc.Sharp()")
    if problem.noise_reacts:
        missing.append(FIXED_NOISE)
    return missing


def _modulus(problem: PerformativeProblem, ranges: ScaleRange) -> tuple[float, dict[str, Any], str]:
    """√(ϱ h), the metric N as a matrix G with its basis, and a remark."""
    problem = simplified(problem)
    basis = tangent_basis(problem)
    if basis.shape[1] == 0:
        return 0.0, {}, "The set is a single policy."
    low = np.where((ranges.low <= 0) & (ranges.high >= 0), 0.0, np.minimum(ranges.low**2, ranges.high**2))
    largest = np.maximum(np.abs(ranges.low), np.abs(ranges.high))
    high = largest**2
    form = expansion(problem, low).form(basis)
    G = form[1:, 1:]
    floor = float(np.linalg.eigvalsh(G)[0])
    if floor <= 1e-12 * float(np.linalg.norm(G, 2)):
        return np.inf, {}, "The cost is not strictly convex along the set without perturbations."
    if ranges.slopes is None:
        lipschitz = ranges.lipschitz / np.sqrt(floor)
    else:
        reduced = ranges.slopes.reshape(-1, ranges.slopes.shape[-1]) @ basis
        whitened = scipy.linalg.solve_triangular(np.linalg.cholesky(G), reduced.T, lower=True)
        lipschitz = np.linalg.norm(whitened, axis=0).reshape(largest.shape)
    at_high, derivative = expansions(problem, high, 2 * largest * lipschitz)
    L = derivative.form(basis)
    values: dict[str, Any] = {"metric": G, "basis": basis}
    if float(np.abs(L[1:, :]).max()) == 0:
        return 0.0, values, "The reaction does not move the best response."
    stretch = float(scipy.linalg.eigh(L[1:, 1:], G, eigvals_only=True)[-1])
    height = largest_on_sublevel(L, form, at_high.least(problem))
    return float(np.sqrt(max(stretch, 0.0) * max(height, 0.0))), values, ""


def largest_on_sublevel(L: np.ndarray, G: np.ndarray, level: float) -> float:
    """An upper bound of max [1;y]ᵀL[1;y] subject to [1;y]ᵀG[1;y] ≤ level, by the dual (any dual point is valid).

    Args:
        L, G: (1+q, 1+q), positive semidefinite, the y-block of G definite. level: at least the minimum of the form G.
    """
    from scipy.optimize import minimize_scalar  # here alone: its import takes 0.2 s

    factor = np.linalg.cholesky(G[1:, 1:])
    centre = -scipy.linalg.cho_solve((factor, True), G[1:, 0])
    slack = max(level - float(G[0, 0] + G[1:, 0] @ centre), 0.0)
    shift = np.concatenate([[1.0], centre])
    constant = float(shift @ L @ shift)
    linear = scipy.linalg.solve_triangular(factor, (L @ shift)[1:], lower=True)
    curved = scipy.linalg.solve_triangular(factor, L[1:, 1:], lower=True)
    curved = scipy.linalg.solve_triangular(factor, curved.T, lower=True)
    values, vectors = np.linalg.eigh((curved + curved.T) / 2)
    weights = (vectors.T @ linear) ** 2
    top = max(float(values[-1]), 0.0)

    def dual(log_excess: float) -> float:
        tau = top + np.exp(log_excess)
        return constant + tau * slack + float(np.sum(weights / (tau - values)))

    scale = np.log(max(top, np.sqrt(weights.sum() / max(slack, 1e-300)), 1e-300))
    found = minimize_scalar(dual, bounds=(scale - 30, scale + 10), method="bounded")
    return min(dual(float(found.x)), dual(scale), dual(scale - 30))  # type: ignore[attr-defined]
