"""The sharp certificate: what is true at the stable policy itself, found exactly, to first order."""

from typing import Any

import numpy as np
from jaxtyping import Array

from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import Result
from perfcontrol.theory.assumptions import Assumption
from perfcontrol.theory.certificates.certificate import Certificate, not_applicable
from perfcontrol.theory.existence import existence
from perfcontrol.theory.stability.contraction import contraction_estimate
from perfcontrol.theory.stability.local_model import largest_mean_step, local_model, obstacles, spectral_radius
from perfcontrol.theory.stability.safe_step import JACOBIAN_SAMPLES, stability_of
from perfcontrol.theory.stability.stable_policy import find_stable_policy, proves_absence


def certify_sharp(
    problem: PerformativeProblem,
    *,
    M: Array | None = None,
    batch: int = 1,
    samples: int = JACOBIAN_SAMPLES,
    pairs: int = 8,
    key: Any = None,
) -> Certificate:
    """The local test at M^PS, with the steps that it allows.

    Args:
        M: the stable policy if it is known already. batch: paths a step of RSGD. samples: of the gradient's Jacobian,
        for the mean-square step; 0 leaves that out. pairs: of policies for the global estimate; 0 leaves it out.
        key: JAX random key of these samples; a fixed one if None.
    """
    missing = obstacles(problem)
    proved, reason = existence(problem)
    if missing:
        return not_applicable("sharp", missing, proved, reason)
    found = True
    if M is None:
        solution = find_stable_policy(problem)
        found = bool(solution.result == Result.success)
        M, residual = solution.M, float(solution.stats["residual"])
        if not found and proved is None and proves_absence(problem):
            return _absent(problem)
        if not found:
            return not_applicable(
                "sharp", [f"the exact solver found no stable policy (best residual {residual:.2g})"], proved, reason
            )
    if proved is None:
        proved, reason = True, "the exact solver found one, to a relative residual of 1e-11"
    model = local_model(problem, M)
    rate = spectral_radius(model.response_jacobian)
    mean_step = largest_mean_step(model)
    values: dict[str, Any] = {"M": np.asarray(M), "mean_field_stable": mean_step > 0, "mean_step": mean_step}
    values["mean_field_eigenvalues"] = np.linalg.eigvals(model.drift)
    notes = [
        f"The mean field of RSGD is stable for constant steps below {mean_step:.4g}."
        if mean_step > 0
        else "The mean field of RSGD is unstable at every step."
    ]
    assumptions = [
        Assumption("derivatives at the stable policy, in floating point", "estimated"),
        Assumption("active constraints are strictly active", "estimated"),
    ]
    if samples and mean_step > 0:
        stability = stability_of(problem, model, mean_step, batch, samples, key)
        values["mean_square"] = stability
        values["mean_square_step"] = stability.threshold_estimate
        values["mean_square_step_error"] = stability.standard_error
        notes.append(
            f"In mean square, with {batch} path{'s' * (batch > 1)} a step, RSGD is stable for constant steps below "
            f"{stability.threshold_estimate:.3g} (standard error {stability.standard_error:.1g}; steps are on the "
            f"gradient summed over stages)."
        )
        floor_step = stability.threshold_estimate / 4
        if np.isfinite(floor_step) and floor_step > 0:
            values["error_floor"] = stability.error_floor(floor_step)
            notes.append(
                f"At a quarter of that it settles at a mean-square error of {values['error_floor']:.3g} about it."
            )
        assumptions.append(Assumption("the mean-square step, from sampled Jacobians", "estimated"))
    if pairs:
        values["contraction_estimate"] = contraction_estimate(problem, pairs=pairs, key=key, center=M)
        notes.append(
            f"Over sampled pairs of feasible policies, far ones included, the best response stretched distances by at "
            f"most {values['contraction_estimate']:.3g} (an estimate; the test itself is only local)."
        )
    return Certificate(
        "sharp",
        True,
        holds=rate < 1,
        exists=proved,
        existence=reason,
        lhs=rate,
        rhs=1.0,
        rate=rate,
        assumptions=tuple(assumptions),
        values=values,
        notes=tuple(notes),
    )


def _absent(problem: PerformativeProblem) -> Certificate:
    """The verdict where the affine equation for a stable policy has no solution."""
    rate = spectral_radius(local_model(problem, problem.initial_policy()).response_jacobian)
    return Certificate(
        "sharp",
        True,
        holds=False,
        exists=False,
        existence="the equation for it is affine and has no solution",
        lhs=rate,
        rhs=1.0,
        rate=rate,
        assumptions=(Assumption("the gradient field M -> g(M; M) is affine, checked at points", "estimated"),),
        notes=("There is no stable policy to converge to.",),
    )
