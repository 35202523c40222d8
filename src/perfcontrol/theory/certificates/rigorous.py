"""The rigorous certificate: the same condition with constants that are proved, and as sharp as the proof allows."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.constants import Constants, rigorous_constants
from perfcontrol.theory.certificates.convexity import rigorous_convexity
from perfcontrol.theory.certificates.declarations import Declarations
from perfcontrol.theory.certificates.ingredients import FROM_NORMS, Ingredients, gather
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.existence import existence
from perfcontrol.theory.stability.strong_stability import StrongStability, candidates


@dataclass(frozen=True, kw_only=True)
class Rigorous(Declarations, AbstractCertificateKind):
    """Σ_k ε_k Σ_{t>k} ν_{t,k} < μ̃ with the corrected constants: proves that Φ is a contraction.

    What is declared goes before what the problem knows; None leaves it to the problem.

    Args:
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
        docs: theory, "The rigorous certificate".
    """

    name: ClassVar[str] = "rigorous"
    title: ClassVar[str] = "The sufficient condition with corrected constants"

    def assess(self, problem: PerformativeProblem) -> Certificate:
        items, exists = gather(problem, self), existence(problem)
        missing = list(items.missing)
        if problem.perturbation.columns(problem.state_size, problem.input_size) > problem.state_size:
            missing.append(
                "the perturbations act on the input, which these bounds leave out: pass directions of shape (k, n, n), "
                "or use pc.Sharp()"
            )
        if missing:
            return self.refuse(missing, exists)
        stability, constants = search(problem, items)
        mu, source = rigorous_convexity(problem, items)
        contributions = items.sensitivity * constants.weights
        aggregate = float(contributions.sum())
        notes = []
        if mu == 0:
            cause = (
                f"the noise does not excite the direction {np.array2string(items.quiet_direction, precision=3)}"
                if items.noise_floor == 0
                else "the stage cost is flat in some direction of the policy"
            )
            notes.append(f"The strong convexity is zero: {cause}.")
        elif aggregate > 0:
            worst = int(np.argmax(contributions))
            notes.append(f"The largest contribution comes from t = {worst} ({contributions[worst] / aggregate:.0%}).")
        return self.conclude(
            aggregate,
            mu,
            exists,
            (FROM_NORMS, *items.assumptions),
            weights=constants.weights,
            contributions=contributions,
            values={"stability": stability, "constants": constants, "ingredients": items, "convexity": source},
            notes=tuple(notes),
        )


def search(problem: PerformativeProblem, items: Ingredients) -> tuple[StrongStability, Constants]:
    """The transform Q with the smallest aggregate S (μ̃ does not depend on it)."""
    pairs = [
        (stability, rigorous_constants(items, stability))
        for stability in candidates(problem.system, np.asarray(problem.gain, dtype=float), items.perturbation_bound)
    ]
    return min(pairs, key=lambda pair: _size(items, pair[1]))


def _size(items: Ingredients, constants: Constants) -> tuple[float, float]:
    aggregate = float(items.sensitivity @ constants.weights)
    return (aggregate if np.isfinite(aggregate) else np.inf, constants.total_smoothness)
