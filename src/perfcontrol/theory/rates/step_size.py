"""The step size of Theorem 1, and the constants of strong monotonicity that it is made of."""

import math
from typing import Any, NamedTuple

from perfcontrol._checks import fail
from perfcontrol.problem import PerformativeProblem, check_end
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.certify import as_kind, certify
from perfcontrol.theory.certificates.kind import AbstractCertificateKind


class TheoremStepSize(NamedTuple):
    """η_n = phi1 / (n + phi2); pass it on as `pc.InverseStep(*step)`."""

    phi1: float
    phi2: float


class DescentConstants(NamedTuple):
    """m = μ̃ - S, L = Σλ + S, V, and the certificate that they come from."""

    monotonicity: float
    lipschitz: float
    variance: float
    certificate: Certificate


def descent_constants(
    problem: PerformativeProblem, kind: str | AbstractCertificateKind = "rigorous", **declared: Any
) -> DescentConstants:
    """m, L and V of a problem.

    Args:
        kind: "rigorous" or "paper", or the object. declared: its settings where it is given by name.

    Raises:
        InputError: the certificate is not applicable, or S ≥ μ̃, so that no step size is proved to work.
    """
    check_end(problem)
    chosen = as_kind(kind, declared)
    if chosen.name not in ("rigorous", "paper"):
        raise fail(
            "kind",
            repr(kind),
            "be 'rigorous' or 'paper'",
            "Pass one of them: only these two come with gradient bounds.",
        )
    certificate = certify(problem, chosen)
    if not certificate.applicable:
        raise fail(
            "problem",
            f"a certificate that is not applicable: {'; '.join(certificate.missing)}",
            f"admit the {chosen.name} certificate",
            "Declare what is missing, or use pc.safe_step.",
        )
    assert certificate.lhs is not None and certificate.rhs is not None
    if not certificate.holds:
        raise fail(
            "problem",
            f"S = {certificate.lhs:.4g} ≥ μ̃ = {certificate.rhs:.4g}",
            "have an aggregated sensitivity S below the strong convexity μ̃",
            "Use pc.safe_step, which finds a step by local analysis: none is proved to work here.",
        )
    constants = certificate.values["constants"]
    return DescentConstants(
        certificate.rhs - certificate.lhs, constants.total_smoothness + certificate.lhs, constants.variance, certificate
    )


def theorem_step_size(
    problem: PerformativeProblem, *, kind: str | AbstractCertificateKind = "rigorous", **declared: Any
) -> TheoremStepSize:
    """φ₁ and φ₂ of the diminishing step η_n = φ₁/(n + φ₂) with the largest first step that the theorem allows.

    φ₁/φ₂ = c with c = min(m/L², 1/m) (as printed: m/(2L²) in place of m/L²), and φ₂ ≥ 1 the smallest for which
    φ₁/(1 + 1/φ₂) ≥ 2/m.

    Args:
        problem: the problem.
        kind: `pc.Rigorous(...)`, or `pc.Paper(...)` for the printed constants; or its name.
        declared: settings of the kind where it is given by name.

    Raises:
        InputError: no such step exists, with the reason.

    References:
        Theorem 1, conditions (17) and (18).
    """
    m, L, _, certificate = descent_constants(problem, kind, **declared)
    first = min(m / L**2 / (2 if certificate.kind == "paper" else 1), 1 / m)
    ratio = 2 / (m * first)
    phi2 = max(1.0, (ratio + math.sqrt(ratio**2 + 4 * ratio)) / 2)
    return TheoremStepSize(first * phi2, phi2)
