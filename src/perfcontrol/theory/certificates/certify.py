"""`pc.certify`: one entrance to every kind of certificate."""

from typing import Any

from perfcontrol._calls import check_keywords
from perfcontrol._checks import check_parentheses, fail
from perfcontrol.problem import PerformativeProblem, check_problem, warn_of_unstable_gain
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.global_bound import GlobalBound
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.certificates.paper import Paper
from perfcontrol.theory.certificates.rigorous import Rigorous
from perfcontrol.theory.certificates.sharp import Sharp
from perfcontrol.theory.existence import existence
from perfcontrol.theory.precision import in_double

SHORTHANDS: dict[str, type[AbstractCertificateKind]] = {
    kind.name: kind for kind in (Paper, Rigorous, GlobalBound, Sharp)
}
KINDS = tuple(SHORTHANDS)


def as_kind(kind: Any, settings: dict[str, Any] | None = None) -> AbstractCertificateKind:
    """The kind itself, or the one that a name and its settings stand for."""
    settings = settings or {}
    if isinstance(kind, AbstractCertificateKind):
        check_keywords(f"a call that is given pc.{type(kind).__name__}(...)", settings, ())
        return kind
    required = f"be one of {KINDS}, or an object such as `pc.Sharp()`"
    check_parentheses("kind", kind, required)
    if kind not in KINDS:
        raise fail("kind", repr(kind), required, "Pass one of these names.")
    return SHORTHANDS[kind](**settings)


@in_double
def certify(
    problem: PerformativeProblem, kind: str | AbstractCertificateKind = "sharp", **settings: Any
) -> Certificate:
    """Does a stable policy exist, does repeated minimisation reach it, and how fast?

    Args:
        problem: the problem.
        kind: `pc.Paper()` (the published sufficient condition, constants as printed), `pc.Rigorous()` (the same
            condition with corrected constants), `pc.GlobalBound()` (a proved contraction bound for quadratic costs and
            fixed directions) or `pc.Sharp()` (exact, but only local: at the stable policy itself). As a shorthand
            "paper", "rigorous", "global" or "sharp".
        settings: of the kind, where its shorthand is used: `pc.certify(problem, "rigorous", noise_bound=2.0)`.

    Returns:
        A `Certificate`; `str()` of it reads as a paragraph.

    Raises:
        InputError: an unknown kind, or a setting of a wrong name or value.

    References:
        Lemma on existence and uniqueness (paper); docs: theory.
    """
    chosen = as_kind(kind, settings)
    warn_of_unstable_gain(check_problem(problem))
    if not (chosen.endless or problem.is_finite):
        return chosen.refuse(["the horizon is infinite: pass problem.truncated(T)"], existence(problem))
    return chosen.assess(problem)
