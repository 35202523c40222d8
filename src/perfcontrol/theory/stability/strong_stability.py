"""Strong stability of the closed loop: A - BK = Q L Q⁻¹ with ‖L‖ ≤ 1 - γ and ‖Q‖, ‖Q⁻¹‖, ‖K‖ ≤ κ.

For a rate ρ above the spectral radius of Ã = A - BK let P solve ÃᵀPÃ/ρ² - P + I = 0. Then Q ∝ P^{-1/2}, scaled so
that ‖Q‖ = ‖Q⁻¹‖ = cond(P)^{1/4}, gives ‖L‖ = ρ √(1 - 1/λ_max(P)): a small ρ buys a fast L with an ill-conditioned
Q, a large one tends to Q = I. Every ρ yields valid constants, so they are searched. Nothing is returned unverified.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg

from perfcontrol._checks import as_array, check_instance, check_shape, check_time_varying, fail
from perfcontrol.systems import LinearSystem

RATES = np.logspace(-3, 2, 26)  # how far above the spectral radius, relative to its size


@dataclass(frozen=True)
class StrongStability:
    """Constants of strong stability, and whether they hold.

    kappa, gamma: the paper's. Q: (n, n). L: Q⁻¹(A - BK)Q, (n, n), or (T, n, n). gain_norm: ‖K‖ and condition:
    ‖Q‖‖Q⁻¹‖ = κ_Q², which sharper bounds keep apart. verified: γ > 0 and A - BK = Q L Q⁻¹ hold numerically; `reason`
    says what fails. factors: (T,) bounds a_t = ‖L_t‖ + ‖Q‖‖Q⁻¹‖ ξ_t of the perturbed steps where ξ_t is given.
    """

    kappa: float
    gamma: float
    Q: np.ndarray
    L: np.ndarray
    gain_norm: float
    condition: float
    verified: bool
    reason: str = ""
    factors: np.ndarray | None = None
    spectral_radius: float = field(default=np.nan)

    @property
    def almost_surely(self) -> bool | None:
        """Whether every perturbed step contracts almost surely in the norm ‖Q⁻¹x‖; None where no ξ_t was given."""
        return None if self.factors is None else bool(np.max(self.factors) < 1)


def _norm(matrix: np.ndarray) -> float:
    return float(np.linalg.norm(matrix, 2)) if matrix.size else 0.0


def closed_loops(system: LinearSystem, K: np.ndarray) -> np.ndarray:
    """A_t - B_t K_t, (T or 1, n, n)."""
    A, B = np.asarray(system.A, dtype=float), np.asarray(system.B, dtype=float)
    if K.ndim == 3 and system.horizon is not None:
        K = K[: system.horizon]
    elif K.ndim == 3:
        K = K[:-1]
    loops = A - B @ K
    return loops if loops.ndim == 3 else loops[None]


def transform(loop: np.ndarray, rate: float) -> np.ndarray:
    """Q for a rate above the spectral radius of `loop`, scaled so that ‖Q‖ = ‖Q⁻¹‖; I for an infinite rate."""
    if not np.isfinite(rate):
        return np.eye(len(loop))
    P = scipy.linalg.solve_discrete_lyapunov((loop / rate).T, np.eye(len(loop)))
    values, vectors = np.linalg.eigh((P + P.T) / 2)
    values = np.maximum(values, 1.0)  # P ⪰ I
    scale = (values[0] * values[-1]) ** 0.25
    return (vectors * (scale / np.sqrt(values))) @ vectors.T


def candidates(
    system: LinearSystem, K: np.ndarray, perturbation_bound: np.ndarray | None = None
) -> Iterator[StrongStability]:
    """One set of constants for every rate of the search, Q = I included; γ may be negative."""
    loops = closed_loops(system, K)
    centre = loops.mean(axis=0)
    radius = float(np.max(np.abs(np.linalg.eigvals(centre))))
    gain_norm = max((_norm(k) for k in (K if K.ndim == 3 else K[None])), default=0.0)
    scale = max(radius, 1e-2)
    for rate in [np.inf, *(radius + scale * RATES)]:
        Q = transform(centre, rate)
        inverse = np.linalg.inv(Q)
        L = inverse @ loops @ Q
        error = max(_norm(Q @ step @ inverse - loop) for step, loop in zip(L, loops, strict=True))
        if not error <= 1e-8 * max(1.0, _norm(centre)):
            continue
        norms = np.array([_norm(step) for step in L])
        condition = _norm(Q) * _norm(inverse)
        kappa, gamma = max(1.0, gain_norm, _norm(Q), _norm(inverse)), 1 - float(norms.max())
        factors = None if perturbation_bound is None else norms + condition * perturbation_bound
        reason = "" if gamma > 0 else f"no contraction: ‖L‖ = {norms.max():.4g}"
        if radius >= 1:
            reason = f"A - BK has spectral radius {radius:.4g}, which is not below 1"
        yield StrongStability(
            kappa,
            gamma,
            Q,
            L if len(L) > 1 else L[0],
            gain_norm,
            condition,
            gamma > 0 and radius < 1,
            reason,
            factors,
            radius,
        )


def _printed_size(found: StrongStability) -> float:
    """κ¹⁰/γ²: what the printed strong-convexity constant divides by."""
    return found.kappa**10 / found.gamma**2 if found.gamma > 0 else np.inf


def strong_stability(
    system: LinearSystem,
    K: Any,
    *,
    perturbation_bound: Any = None,
    objective: Callable[[StrongStability], float] | None = None,
) -> StrongStability:
    """κ, γ, Q and L for the closed loop A - BK, searched over the rate and verified.

    Args:
        system: A and B.
        K: (m, n), or (T+1, m, n); u = -K x.
        perturbation_bound: ξ_t, (T,) or a number; then `.factors` bounds the perturbed steps almost surely.
        objective: what to minimise over the search; None: κ¹⁰/γ², the size of the printed constants.

    Returns:
        The best constants, with `verified=False` and the reason where A - BK is not strongly stable (then those of
        the smallest ‖L‖).

    Raises:
        InputError: wrong shapes; a negative bound.

    References:
        Definition 2; Proposition 1 for the almost-sure version.
    """
    check_instance("system", system, LinearSystem, "pc.LinearSystem(A, B)")
    K = as_array("K", K)
    n, m = system.state_size, system.input_size
    if K.ndim == 3:
        check_time_varying("K", K, (m, n), ("m", "n"), (system.horizon or K.shape[0] - 1) + 1, "T+1")
    else:
        check_shape("K", K, (m, n), ("m", "n"))
    gain = np.asarray(K, dtype=float)
    xi = None
    if perturbation_bound is not None:
        steps = system.horizon if system.horizon is not None else (K.shape[0] - 1 if K.ndim == 3 else None)
        xi = check_per_step("perturbation_bound", perturbation_bound, steps)
    measure = _printed_size if objective is None else objective
    found = list(candidates(system, gain, xi))
    verified = [item for item in found if item.verified]
    if verified:
        return min(verified, key=measure)
    if not found:
        raise fail("system", "a closed loop too badly conditioned", "allow a transform", "Rescale the states.")
    return max(found, key=lambda item: item.gamma)


def check_per_step(name: str, value: Any, horizon: int | None) -> np.ndarray:
    """`value` as non-negative numbers (T,); a single number is repeated."""
    array = np.asarray(as_array(name, value), dtype=float)
    if array.ndim == 0:
        array = np.full(1 if horizon is None else horizon, float(array))
    if array.ndim != 1 or (horizon is not None and len(array) != horizon):
        wanted = "have one entry for each t = 0..T-1" + ("" if horizon is None else f", that is {horizon}")
        raise fail(name, f"shape {array.shape}", wanted, "Pass one of them; a single number is repeated.")
    if np.any(array < 0):
        t = int(np.argmin(array))
        raise fail(
            name, f"{array[t]:.4g} at t = {t}", "be non-negative", "Pass zero or more: it bounds a norm or a distance."
        )
    return array
