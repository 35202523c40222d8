"""Propositions 1 and 2 as functions: what stability of the dynamics asks of the sensitivities.

Both are about the sufficient condition S = Σ_k ε_k w_k < μ̃ with the weights w_k = Σ_{t>k} ν_{t,k}, not about existence.
Proposition 1: Σ ε_k < μ̃ / max_k w_k is enough, in whatever order. Proposition 2: the condition cannot hold unless
ε_k < μ̃ / w_k for every k, an envelope that falls off backwards in time where the dynamics grow.
"""

from typing import Any, NamedTuple

import numpy as np

from perfcontrol._checks import check_integer, fail
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.certify import certify
from perfcontrol.theory.certificates.ingredients import Ingredients


class SumThreshold(NamedTuple):
    """Proposition 1. threshold: of Σ ε_t; total: Σ ε_t; holds: total < threshold; zeta: the largest step factor a_t,
    below 1 where the perturbed dynamics are strongly stable almost surely."""

    threshold: float
    total: float
    holds: bool
    zeta: float


class SensitivityEnvelope(NamedTuple):
    """Proposition 2. epsilon: the problem's ε_t; envelope: what each must stay below for the condition to be
    satisfiable, (T,) both; holds: whether all do; zeta: as in `SumThreshold`."""

    epsilon: np.ndarray
    envelope: np.ndarray
    holds: bool
    zeta: float


def _certificate(problem: PerformativeProblem, printed: bool, declared: dict[str, Any]) -> Certificate:
    certificate = certify(problem, "paper" if printed else "rigorous", **declared)
    if not certificate.applicable:
        raise fail(
            "problem",
            "; ".join(certificate.missing),
            "meet the assumptions of the propositions",
            "Declare what is missing, or bound the feasible set.",
        )
    return certificate


def _largest_factor(certificate: Certificate) -> float:
    """max a_t: α_{t+1}/α_t of the constants."""
    alpha = certificate.values["constants"].alpha
    return float(np.max(np.divide(alpha[1:], alpha[:-1], out=np.zeros(len(alpha) - 1), where=alpha[:-1] > 0)))


def printed_pieces(items: Ingredients, kappa: float, gamma: float) -> tuple[float, float, float]:
    """c₁, c₂, c₃ of the main text."""
    varsigma, G = float(items.smoothness.max()), float(items.gradient_bound.max())
    H, W, b, d = items.memory, items.noise_bound, items.input_norm, items.state_size
    scale = d * H**1.5 * W / (1 - gamma)
    c1 = varsigma * scale * (1 + (kappa**2 + kappa**3) * b) * (kappa**2 + kappa**3)
    return c1, scale * G * (kappa**4 + kappa**5) * b, (H * items.policy_bound * b + 1) * W


def sum_threshold(problem: PerformativeProblem, *, printed: bool = False, **declared: Any) -> SumThreshold:
    """Proposition 1: below which total sensitivity the condition holds in every order.

    Args:
        printed: φ(1 - H/T)μ̄ with the printed constants, for ζ < 1; else μ̃ / max_k w_k with the rigorous ones, which
        needs no stability.

    Raises:
        InputError: the certificate is not applicable; for the printed form, dynamics that are not strongly stable.
    """
    certificate = _certificate(problem, printed, declared)
    items, zeta = certificate.values["ingredients"], _largest_factor(certificate)
    assert certificate.weights is not None and certificate.rhs is not None
    if printed:
        if zeta >= 1:
            raise fail(
                "problem", f"ζ = {zeta:.4g}", "be strongly stable almost surely (ζ < 1)", "Use Proposition 2 there."
            )
        c1, c2, c3 = printed_pieces(items, certificate.values["kappa"], certificate.values["gamma"])
        mu_bar = certificate.rhs / (items.horizon - items.memory + 1)
        phi = 1 / ((c1 + c2 / (1 - zeta)) * (items.initial_bound + c3 / (1 - zeta)))
        threshold = phi * (1 - items.memory / items.horizon) * mu_bar
    else:
        largest = float(certificate.weights.max())
        threshold = certificate.rhs / largest if largest > 0 else np.inf
    total = float(items.sensitivity.sum())
    return SumThreshold(threshold, total, total < threshold, zeta)


def sensitivity_envelope(
    problem: PerformativeProblem, *, printed: bool = False, **declared: Any
) -> SensitivityEnvelope:
    """Proposition 2: how large each ε_t may be at most if the condition is to hold.

    Args:
        printed: φ̄(T-H+1)μ̄/(ζ^{T-t} - 1) with the printed constants, for ζ > 1; else μ̃/w_t, rigorous.

    Raises:
        InputError: the certificate is not applicable; for the printed form, ζ ≤ 1.
    """
    certificate = _certificate(problem, printed, declared)
    items, zeta = certificate.values["ingredients"], _largest_factor(certificate)
    assert certificate.weights is not None and certificate.rhs is not None
    if printed:
        if zeta <= 1:
            raise fail("problem", f"ζ = {zeta:.4g}", "be unstable (ζ > 1)", "Use Proposition 1 there.")
        c1, c2, c3 = printed_pieces(items, certificate.values["kappa"], certificate.values["gamma"])
        x0 = items.initial_bound
        scale = certificate.rhs * (zeta - 1) / (c1 * x0 + (c1 * c3 + c2 * c3 + c3 * x0) / zeta)
        envelope = scale * envelope_shape(zeta, items.horizon, printed=True)
    else:
        weights = certificate.weights
        envelope = np.divide(certificate.rhs, weights, out=np.full(len(weights), np.inf), where=weights > 0)
    return SensitivityEnvelope(items.sensitivity, envelope, bool(np.all(items.sensitivity < envelope)), zeta)


def envelope_shape(zeta: float, horizon: int, *, printed: bool = False) -> np.ndarray:
    """The shape in t = 0..T-1 of Proposition 2's envelope for growth ζ > 1, (T,).

    1/Σ_{i=t+1..T} ζⁱ · 1/(ζ-1) = 1/(ζ^{T+1} - ζ^{t+1}); printed: 1/(ζ^{T-t} - 1), which drops the factor ζ^{t+1}.
    """
    horizon = check_integer("horizon", horizon, 1)
    if not zeta > 1:
        raise fail(
            "zeta", f"{zeta}", "exceed 1", "Use Proposition 1 otherwise: Proposition 2 is about growing dynamics."
        )
    t = np.arange(horizon)
    if printed:
        return 1 / (zeta ** (horizon - t) - 1.0)
    return 1 / (zeta ** (horizon + 1.0) - zeta ** (t + 1.0))
