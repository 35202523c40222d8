"""Existence of a stable policy by compactness, apart from any contraction.

Two fixed-point arguments (docs: theory, section on existence), neither of which needs small sensitivities:

- *bounded set*: 𝕄 compact and convex, D_t continuous ⇒ Φ is upper hemicontinuous with convex values (Kakutani).
- *bounded response*: quadratic cost, fixed directions, mean of Δ free of the policy, continuous scales, an affine
  set, and a cost that is strictly convex along the set already without perturbations. C_T(·; M') is then a weighted
  least-squares problem whose non-negative weights alone depend on M', and such minimisers stay in one bounded set.
"""

from typing import NamedTuple

import numpy as np

from perfcontrol.costs import QuadraticCost
from perfcontrol.perturbations import DirectionalPerturbation, NoPerturbation, SampledPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption, Status, reaction_status, word_of
from perfcontrol.theory.derivatives import hessian_without_reaction, tangent_basis
from perfcontrol.theory.facts import facts, in_free_parameters
from perfcontrol.theory.precision import in_double


class Existence(NamedTuple):
    """Whether a stable policy exists: True, False or None (unknown), why, and what that rests on."""

    exists: bool | None
    reason: str
    assumptions: tuple[Assumption, ...] = ()


def set_radius(problem: PerformativeProblem) -> float | None:
    """sup ‖M‖_F over the feasible set, free parameters; None if unbounded."""
    radius = facts(problem).radius
    return None if radius is None else float(radius)


def reaction_is_continuous(problem: PerformativeProblem) -> bool:
    """Whether M ↦ D_t(M) is continuous, by proof or by the user's word: `reaction_status` tells which."""
    law = problem.perturbation
    if problem.noise_reacts:
        return False
    if facts(problem).sensitivity is not None:
        return True
    return not isinstance(law, SampledPerturbation) and type(law).__module__.startswith("perfcontrol.")


@in_double
def existence(problem: PerformativeProblem) -> Existence:
    """True with the argument that gives it, or None with the reason why neither argument applies."""
    if not problem.is_finite:
        return Existence(None, "on an infinite horizon only policies that keep the world mean-square stable respond")
    continuous = Assumption("the reaction is continuous in the deployed policy", reaction_status(problem.perturbation))
    radius = set_radius(problem)
    if radius is not None and reaction_is_continuous(problem):
        convex = Assumption("the stage cost is continuous and convex", _cost_status(problem))
        return Existence(
            True,
            "the feasible set is compact and convex and the reaction continuous (Kakutani's theorem)",
            (continuous, convex, *word_of(problem)),
        )
    if bounded_response(problem):
        return Existence(
            True,
            "best responses are minimisers of least-squares problems whose non-negative weights alone depend on the "
            "deployed policy, so they stay in a bounded set (Brouwer's theorem)",
            (continuous, *word_of(problem)),
        )
    if radius is None:
        return Existence(None, "the feasible set is unbounded, and no other argument applies")
    return Existence(None, "the reaction is not known to be continuous")


def _cost_status(problem: PerformativeProblem) -> Status:
    return "proved" if isinstance(problem.cost, QuadraticCost) else "declared"


def bounded_response(problem: PerformativeProblem) -> bool:
    """Whether the least-squares argument applies."""
    law = problem.perturbation
    if not isinstance(problem.cost, QuadraticCost) or not problem.feasible_set.affine or problem.noise_reacts:
        return False
    if isinstance(law, DirectionalPerturbation):
        if not constant_mean(problem):
            return False
    elif not isinstance(law, NoPerturbation):
        return False
    basis = tangent_basis(problem)
    if basis.shape[1] == 0:
        return True
    values = np.linalg.eigvalsh(basis.T @ hessian_without_reaction(problem) @ basis)
    return bool(values[0] > 1e-10 * max(values[-1], np.finfo(float).tiny))


def constant_mean(problem: PerformativeProblem) -> bool:
    """Whether E Δ_t is the same for every policy of the set: known to the family, or an affine map with no slope
    along the set."""
    law = problem.perturbation
    if law.policy_free_mean(problem.lifted_set):
        return True
    derivative = law.mean_derivative()
    if derivative is None:
        return False
    slopes = in_free_parameters(problem, derivative).astype(float)
    along_set = np.abs(slopes @ tangent_basis(problem))
    return bool(np.max(along_set, initial=0.0) <= 1e-12 * (1 + np.max(np.abs(slopes))))
