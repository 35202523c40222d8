"""The paper's certificate: Σ_t ε_t Σ_{i>t} ν_i < μ̃ with the constants as printed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.constants import Constants, printed_constants, repaired_constants
from perfcontrol.theory.certificates.convexity import printed_convexity
from perfcontrol.theory.certificates.declarations import Declarations
from perfcontrol.theory.certificates.ingredients import FROM_NORMS, Ingredients, gather
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.existence import constant_mean, existence
from perfcontrol.theory.facts import facts
from perfcontrol.theory.stability.strong_stability import StrongStability, candidates

SHRINKING = (1.0, 0.9, 0.75, 0.5, 0.25, 0.1)  # a smaller γ is valid too, and 1/(1-γ) may like it


@dataclass(frozen=True, kw_only=True)
class Paper(Declarations, AbstractCertificateKind):
    """The paper's sufficient condition Σ_t ε_t Σ_{i>t} ν_i < μ̃, with the constants as printed.

    What is declared goes before what the problem knows; None leaves it to the problem.

    Args:
        repaired: mend the slips of the printed constants, improving nothing else.
        noise_bound: W ≥ ‖w_t‖.
        initial_bound: of ‖x_0‖.
        policy_bound: of ‖M‖_F over the feasible set.
        perturbation_bound: ξ_t ≥ ‖Δ_t‖, a number or (T,).
        sensitivity: ε_t per unit of ‖M - M'‖_F, a number or (T,).
        strong_convexity: μ_t of the stage cost, a number or (T+1,).
        smoothness: ς_t of the stage cost, a number or (T+1,).
        gradient_bound: G_t of the stage cost, a number or (T+1,).
        estimate: sample the constants of a general cost that lacks them.

    Raises:
        InputError: a negative value, or (in `pc.certify`) a wrong length.

    References:
        Lemma on existence and uniqueness.
    """

    repaired: bool = False

    name: ClassVar[str] = "paper"
    title: ClassVar[str] = "The paper's sufficient condition"

    def assess(self, problem: PerformativeProblem) -> Certificate:
        items, exists = gather(problem, self), existence(problem)
        missing = assumptions_missing(problem, items)
        if missing:
            return self.refuse(missing, exists)
        found = search(problem, items, repaired_constants if self.repaired else printed_constants)
        if found is None:
            stability = next(candidates(problem.system, np.asarray(problem.gain, dtype=float)))
            unstable = f"K does not make the system strongly stable ({stability.reason})"
            return self.refuse([f"{unstable}: pass gain=pc.design_gain(system, Q=Q, R=R)"], exists)
        stability, gamma, constants, mu = found
        contributions = items.sensitivity * constants.weights
        constants_are = "repaired" if self.repaired else "as printed"
        notes = [f"The constants are {constants_are}, with κ = {stability.kappa:.4g} and γ = {gamma:.4g} by search."]
        if mu == 0:
            notes.append(
                "The strong convexity is zero, since the noise does not excite the direction "
                f"{np.array2string(items.quiet_direction, precision=3)}."
            )
        trust = Assumption("the printed constants, which are not all right: see the errata", "declared")
        constants_follow = FROM_NORMS if self.repaired else trust
        return self.conclude(
            float(contributions.sum()),
            mu,
            exists,
            (constants_follow, *items.assumptions),
            contraction=self.repaired,
            weights=constants.weights,
            contributions=contributions,
            values={
                "kappa": stability.kappa,
                "gamma": gamma,
                "stability": stability,
                "constants": constants,
                "ingredients": items,
            },
            notes=tuple(notes),
        )


def assumptions_missing(problem: PerformativeProblem, items: Ingredients) -> list[str]:
    """Which of A1-A6 the problem does not meet."""
    missing = list(items.missing)
    if items.noise_mean > 1e-9 * max(1.0, items.noise_bound):
        missing.append("the noise has a mean (assumption A1): pass one without, such as noise=pc.Uniform(-1.0, 1.0)")
    known = facts(problem)
    if known.noise_covariance.ndim == 3:
        missing.append(
            "the noise is not identically distributed (assumption A1): pass one law, noise=pc.Uniform(low, high)"
        )
    if problem.perturbation.columns(problem.state_size, problem.input_size) > problem.state_size:
        missing.append("the perturbations act on the input (assumption A2): pass directions of shape (k, n, n)")
    if known.perturbation_mean is None:
        missing.append(
            "the mean of the perturbations is not known (assumption A2): "
            "pass a family that knows it, such as pc.DirectionalPerturbation(directions, scale)"
        )
    elif not constant_mean(problem) or np.any(known.perturbation_mean):
        missing.append("the perturbations have a mean (assumption A2): pass mean=None and put a constant one into A")
    if problem.system.horizon is not None or problem.gain.ndim == 3:
        missing.append("the system or its gain varies in time: pass A of shape (n, n) and gain of shape (m, n)")
    if np.all(np.isfinite(items.strong_convexity)) and items.strong_convexity.min() <= 0:
        missing.append(
            "the stage cost is not strongly convex in state and input together (assumption A4): "
            "pass definite weights, such as pc.QuadraticCost(Q + 0.01 * np.eye(n), R + 0.01 * np.eye(m))"
        )
    if np.max(items.gradient_offset) > 0:
        missing.append("the gradient of the stage cost is not zero at the origin (assumption A6): pass no targets")
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
