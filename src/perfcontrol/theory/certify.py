"""`pc.certify`: one entrance to the four certificates."""

from typing import Any

from perfcontrol._checks import fail
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.certificate import KINDS, Certificate
from perfcontrol.theory.local import check_problem
from perfcontrol.theory.sharp import certify_sharp


def certify(problem: PerformativeProblem, kind: str = "sharp", **options: Any) -> Certificate:
    """Does a stable policy exist, and how fast do the methods reach it?"""
    check_problem(problem)
    kinds = {"sharp": certify_sharp}
    if kind not in kinds:
        raise fail("kind", repr(kind), f"be one of {KINDS}", "Pass one of these names.")
    return kinds[kind](problem, **options)
