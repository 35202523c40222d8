"""The rigorous certificate: the same condition with constants that are proved, and as sharp as the proof allows."""

from typing import Any

import numpy as np

from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption
from perfcontrol.theory.certificates.certificate import Certificate, not_applicable
from perfcontrol.theory.certificates.constants import Constants, rigorous_constants
from perfcontrol.theory.certificates.convexity import rigorous_convexity
from perfcontrol.theory.certificates.ingredients import Ingredients, gather
from perfcontrol.theory.existence import existence
from perfcontrol.theory.stability.strong_stability import StrongStability, candidates


def obstacles(problem: PerformativeProblem, items: Ingredients) -> list[str]:
    """What keeps the rigorous certificate from applying."""
    missing = list(items.missing)
    if problem.perturbation.columns(problem.state_size, problem.input_size) > problem.state_size:
        missing.append("the perturbations act on the input, which these bounds leave out")
    return missing


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


def certify_rigorous(problem: PerformativeProblem, *, estimate: bool = False, **declared: Any) -> Certificate:
    """Σ_k ε_k Σ_{t>k} ν_{t,k} < μ̃ with the corrected constants: proves that Φ is a contraction.

    Args:
        estimate: sample the constants of a general cost that lacks them. declared: values that the problem does not
        know, see `gather`.

    References:
        docs: theory, "The rigorous certificate".
    """
    items = gather(problem, declared, estimate=estimate)
    exists, reason = existence(problem)
    missing = obstacles(problem, items)
    if missing:
        return not_applicable("rigorous", missing, exists, reason)
    stability, constants = search(problem, items)
    mu, source = rigorous_convexity(problem, items)
    contributions = items.sensitivity * constants.weights
    aggregate = float(contributions.sum())
    holds = aggregate < mu
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
    if exists is None and holds:
        exists, reason = True, "Φ is a contraction of a closed set"
    return Certificate(
        "rigorous",
        True,
        holds=holds,
        exists=exists,
        existence=reason,
        lhs=aggregate,
        rhs=mu,
        rate=aggregate / mu if mu > 0 else np.inf,
        weights=constants.weights,
        contributions=contributions,
        assumptions=(
            Assumption("the constants follow from norms of the problem's matrices and laws", "proved"),
            *items.assumptions,
        ),
        values={"stability": stability, "constants": constants, "ingredients": items, "convexity": source},
        notes=tuple(notes),
    )
