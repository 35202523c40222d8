"""Error bounds: what contraction and strong monotonicity promise of RRM and RSGD.

With m = μ̃ - S > 0 (S the aggregated sensitivity), L = Σ λ_t + S, V ≥ Var ∇J_T and b paths a step, comparing with
M^PS = Proj(M^PS - η g^PS) (no interior point is needed) gives

    E_{n+1} ≤ (1 - 2 η_n m + η_n² L²) E_n + η_n² V/b,      E_n = E ‖M_n - M^PS‖²_F,

and for η_0 ≤ min(m/L², 1/m), η_n/η_{n+1} ≤ 1 + m η_{n+1}/2:  E_N ≤ Π_{n<N}(1 - η_n m) E_0 + 2 η_{N-1} V/(b m).
"""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import check_integer, fail
from perfcontrol.problem import PerformativeProblem, check_end
from perfcontrol.solvers import InverseStep
from perfcontrol.solvers.step_sizes import as_step_size
from perfcontrol.theory.certificates.certify import as_kind, certify
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.rates.step_size import descent_constants


def rrm_error_bound(
    problem: PerformativeProblem,
    initial_error: float,
    steps: int,
    *,
    kind: str | AbstractCertificateKind = "rigorous",
    **settings: Any,
) -> np.ndarray:
    """‖M_n - M^PS‖_F ≤ rateⁿ ‖M_0 - M^PS‖_F for n = 0..steps, (steps+1,).

    For the global kind the contraction is in the norm N; the bound then carries √cond of it once.

    Args:
        problem: the problem.
        initial_error: ‖M_0 - M^PS‖_F, or a bound of it such as the diameter of the set.
        steps: N.
        kind: `pc.Rigorous(...)`, `pc.Paper(...)` or `pc.GlobalBound(...)`, or its name.
        settings: of the kind where it is given by name.

    Raises:
        InputError: the certificate is not applicable or does not hold.

    References:
        Lemma on existence and uniqueness.
    """
    steps = check_integer("steps", steps, 0)
    initial_error = _error("initial_error", initial_error)
    chosen = as_kind(kind, settings)
    if chosen.name not in ("rigorous", "paper", "global"):
        raise fail(
            "kind",
            repr(kind),
            "be 'rigorous', 'paper' or 'global'",
            "Pass one of them: the sharp test is local, and bounds nothing.",
        )
    certificate = certify(check_end(problem), chosen)
    if not certificate.holds:
        raise fail(
            "problem",
            str(certificate),
            f"satisfy the {chosen.name} certificate",
            "Use pc.Sharp() for a local rate: no contraction is proved.",
        )
    assert certificate.rate is not None
    factor = 1.0
    if chosen.name == "global" and "metric" in certificate.values:
        values = np.linalg.eigvalsh(certificate.values["metric"])
        factor = math.sqrt(values[-1] / values[0])
    curve = factor * initial_error * certificate.rate ** np.arange(steps + 1.0)
    curve[0] = initial_error
    return curve


def rsgd_error_bound(
    problem: PerformativeProblem,
    step_size: Any,
    initial_error: float,
    steps: int,
    *,
    batch: int = 1,
    kind: str | AbstractCertificateKind = "rigorous",
    form: str = "recursion",
    **declared: Any,
) -> np.ndarray:
    """A bound of E ‖M_n - M^PS‖²_F along RSGD for n = 0..steps, (steps+1,).

    Args:
        problem: the problem.
        step_size: as `pc.RSGD` takes it.
        initial_error: E ‖M_0 - M^PS‖²_F.
        steps: N.
        batch: paths a step.
        kind: whose constants: `pc.Rigorous(...)` or `pc.Paper(...)`, or its name.
        form: "recursion" (any step sizes; the sharpest), "closed" (the product and 2η_{N-1}V/m; step sizes as in the
            general-step lemma) or "printed" (Theorem 1 as printed, with e^{-Σ_{n=1}^N φ₁m/n} in place of the product,
            which can be too small, and 4 in place of 2).
        declared: settings of the kind where it is given by name.

    Raises:
        InputError: no step is proved to work, or the step sizes break the conditions of the form asked for.

    References:
        Theorem 1; the lemma for general step sizes (Appendix G).
    """
    steps, batch = check_integer("steps", steps, 0), check_integer("batch", batch, 1)
    initial_error = _error("initial_error", initial_error)
    m, L, V, _ = descent_constants(problem, kind, **declared)
    rule = as_step_size(step_size)
    values = [np.asarray(rule(jnp.asarray(n))) for n in range(steps)]
    eta = np.array(values, dtype=float)
    curve = np.empty(steps + 1)
    curve[0] = initial_error
    if form == "recursion":
        for n in range(steps):
            curve[n + 1] = (1 - 2 * eta[n] * m + (eta[n] * L) ** 2) * curve[n] + eta[n] ** 2 * V / batch
        return curve
    if form == "printed":
        if not isinstance(rule, InverseStep):
            raise fail("step_size", type(rule).__name__, "be an InverseStep for Theorem 1", "Pass form='closed'.")
        phi1 = float(rule.phi1)
        n = np.arange(1, steps + 1)
        curve[1:] = np.exp(-m * phi1 * np.cumsum(1 / n)) * initial_error + 4 * phi1 * V / (m * batch * n)
        return curve
    if form != "closed":
        raise fail("form", repr(form), "be 'recursion', 'closed' or 'printed'", "Pass one of these names.")
    limit = min(m / L**2, 1 / m)
    rounding = 1 + max(1e-12, 4 * float(np.finfo(np.result_type(np.float32, *values)).eps))
    slow = np.all(eta[:-1] <= eta[1:] * (1 + m * eta[1:] / 2) * rounding) if steps > 1 else True
    if steps and (eta.max() > limit * rounding or not slow):
        raise fail(
            "step_size",
            f"a first step {eta.max():.3g}",
            f"start at most at min(m/L², 1/m) = {limit:.3g} and shrink by at most 1 + mη/2 a step",
            "Use pc.theorem_step_size, or form='recursion'.",
        )
    product = np.cumprod(1 - eta * m)
    curve[1:] = product * initial_error + 2 * eta * V / (m * batch)
    return curve


def _error(name: str, value: Any) -> float:
    value = float(value)
    if not (value >= 0 and math.isfinite(value)):
        raise fail(
            name, str(value), "be a non-negative number", "Pass zero or more: it is a distance to the stable policy."
        )
    return value
