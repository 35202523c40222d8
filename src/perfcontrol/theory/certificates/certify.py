"""`pc.certify`: one entrance to the four certificates."""

from collections.abc import Callable
from typing import Any

from perfcontrol._checks import fail
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.certificates.certificate import KINDS, Certificate
from perfcontrol.theory.certificates.global_bound import certify_global
from perfcontrol.theory.certificates.paper import certify_paper
from perfcontrol.theory.certificates.rigorous import certify_rigorous
from perfcontrol.theory.certificates.sharp import certify_sharp
from perfcontrol.theory.derivatives import check_problem

CERTIFIERS: dict[str, Callable[..., Certificate]] = {
    "paper": certify_paper,
    "rigorous": certify_rigorous,
    "global": certify_global,
    "sharp": certify_sharp,
}


def certify(problem: PerformativeProblem, kind: str = "sharp", **options: Any) -> Certificate:
    """Does a stable policy exist, does repeated minimisation reach it, and how fast?

    Args:
        problem: the problem.
        kind: "paper" (the published sufficient condition, constants as printed), "rigorous" (the same condition with
            corrected constants), "global" (a proved contraction bound for quadratic costs and fixed directions) or
            "sharp" (exact, but only local: at the stable policy itself).
        options: of that kind: `declared` values for "paper" and "rigorous" (such as sensitivity=..., noise_bound=...,
            strong_convexity=...) and estimate=True; scale_range for "global"; batch, samples, pairs, key for "sharp".

    Returns:
        A `Certificate`; `str()` of it reads as a paragraph.

    Raises:
        InputError: an unknown kind, or an option with a wrong value.

    References:
        Lemma on existence and uniqueness (paper); docs: theory.
    """
    check_problem(problem)
    if kind not in CERTIFIERS:
        raise fail("kind", repr(kind), f"be one of {KINDS}", "Pass one of these names.")
    return CERTIFIERS[kind](problem, **options)
