"""The paper's certificate: Σ_t ε_t Σ_{i>t} ν_i < μ̃ with the constants as printed."""

from collections.abc import Callable
from typing import Any

import numpy as np

from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption
from perfcontrol.theory.certificates.certificate import Certificate, not_applicable
from perfcontrol.theory.certificates.constants import Constants, printed_constants, repaired_constants
from perfcontrol.theory.certificates.convexity import printed_convexity
from perfcontrol.theory.certificates.ingredients import Ingredients, gather
from perfcontrol.theory.derivatives import fixed_noise
from perfcontrol.theory.existence import constant_mean, existence
from perfcontrol.theory.stability.strong_stability import StrongStability, candidates

SHRINKING = (1.0, 0.9, 0.75, 0.5, 0.25, 0.1)  # a smaller γ is valid too, and 1/(1-γ) may like it


def assumptions_missing(problem: PerformativeProblem, items: Ingredients) -> list[str]:
    """Which of A1-A6 the problem does not meet."""
    missing = list(items.missing)
    if items.noise_mean > 1e-9 * max(1.0, items.noise_bound):
        missing.append("the noise has a mean (assumption A1)")
    if fixed_noise(problem).covariance.ndim == 3:
        missing.append("the noise is not identically distributed (assumption A1)")
    if problem.perturbation.columns(problem.state_size, problem.input_size) > problem.state_size:
        missing.append("the perturbations act on the input (assumption A2)")
    mean = problem.perturbation.mean(problem.structure.lift(problem.initial_policy()), problem.horizon)
    if mean is None:
        missing.append("the mean of the perturbations is not known (assumption A2)")
    elif not constant_mean(problem) or float(np.abs(np.asarray(mean)).max()) > 0:
        missing.append("the perturbations have a mean (assumption A2)")
    if problem.system.horizon is not None or problem.gain.ndim == 3:
        missing.append("the system or its gain varies in time")
    if np.all(np.isfinite(items.strong_convexity)) and items.strong_convexity.min() <= 0:
        missing.append("the stage cost is not strongly convex in state and input together (assumption A4)")
    if np.max(items.gradient_offset) > 0:
        missing.append("the gradient of the stage cost is not zero at the origin (assumption A6)")
    return missing


def search(
    problem: PerformativeProblem,
    items: Ingredients,
    constants: Callable[[Ingredients, float, float], Constants],
) -> tuple[StrongStability, float, Constants, float] | None:
    """The strong-stability constants with the smallest ratio S/μ̃: (stability, γ, constants, μ̃)."""
    best = None
    for stability in candidates(problem.system, np.asarray(problem.gain, dtype=float)):
        if not stability.verified:
            continue
        for shrink in SHRINKING:
            gamma = stability.gamma * shrink
            if gamma >= 1 - 1e-9:
                continue
            found = constants(items, stability.kappa, gamma)
            mu = printed_convexity(items, stability.kappa, gamma)
            aggregate = float(items.sensitivity @ found.weights)
            score = (aggregate / mu if mu > 0 else np.inf, aggregate)
            if best is None or score < best[0]:
                best = score, (stability, gamma, found, mu)
    return None if best is None else best[1]


def certify_paper(
    problem: PerformativeProblem, *, repaired: bool = False, estimate: bool = False, **declared: Any
) -> Certificate:
    """The paper's sufficient condition (Lemma on existence and uniqueness).

    Args:
        repaired: mend the slips of the printed constants, improving nothing else. estimate: sample the constants of
        a general cost that lacks them. declared: values that the problem does not know, see `gather`.
    """
    items = gather(problem, declared, estimate=estimate)
    exists, reason = existence(problem)
    missing = assumptions_missing(problem, items)
    kind = "paper"
    if missing:
        return not_applicable(kind, missing, exists, reason)
    found = search(problem, items, repaired_constants if repaired else printed_constants)
    if found is None:
        stability = next(candidates(problem.system, np.asarray(problem.gain, dtype=float)))
        return not_applicable(kind, [f"K does not make the system strongly stable: {stability.reason}"], exists, reason)
    stability, gamma, constants, mu = found
    aggregate = float(items.sensitivity @ constants.weights)
    notes = [f"Searched constants: κ = {stability.kappa:.4g}, γ = {gamma:.4g}."]
    if mu == 0:
        notes.append(
            "The strong convexity is zero, since the noise does not excite the direction "
            f"{np.array2string(items.quiet_direction, precision=3)}."
        )
    holds = aggregate < mu
    trust = Assumption("the printed constants, which are not all right: see the errata", "declared")
    return Certificate(
        kind,
        True,
        holds=holds,
        exists=True if exists is None and holds and repaired else exists,
        existence="Φ contracts" if exists is None and holds and repaired else reason,
        lhs=aggregate,
        rhs=mu,
        rate=aggregate / mu if mu > 0 else np.inf,
        weights=constants.weights,
        contributions=items.sensitivity * constants.weights,
        assumptions=(*([] if repaired else [trust]), *items.assumptions),
        values={
            "kappa": stability.kappa,
            "gamma": gamma,
            "stability": stability,
            "constants": constants,
            "ingredients": items,
        },
        notes=tuple(notes),
    )
