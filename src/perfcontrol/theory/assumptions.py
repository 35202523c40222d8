"""How a fact about a problem is known: proved, declared by the user, or estimated."""

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx

from perfcontrol.perturbations import AbstractPerturbation, SampledPerturbation
from perfcontrol.policy_maps import AbstractPolicyMap
from perfcontrol.problem import PerformativeProblem

Status = Literal["proved", "declared", "estimated"]
STRENGTH: tuple[Status, ...] = ("proved", "declared", "estimated")


@dataclass(frozen=True)
class Assumption:
    """One thing that a verdict rests on, and how it is known.

    status: "proved" (follows from the problem as given), "declared" (taken from the user's word), or "estimated"
    (sampled or computed in floating point at a point, without a proof).
    """

    text: str
    status: Status

    def __str__(self) -> str:
        return f"{self.text} ({self.status})"


def weakest(assumptions: Iterable[Assumption]) -> Status:
    """How a conclusion from all of them is known."""
    return STRENGTH[max((STRENGTH.index(item.status) for item in assumptions), default=0)]


def _parts(part: Any) -> Iterator[Any]:
    """`part` and the modules that it is made of."""
    if isinstance(part, eqx.Module):
        yield part
        for field in dataclasses.fields(part):
            yield from _parts(getattr(part, field.name, None))
    elif isinstance(part, tuple | list):
        for item in part:
            yield from _parts(item)


def _of_the_package(part: Any) -> bool:
    return type(part).__module__.startswith("perfcontrol.")


def word_of(problem: PerformativeProblem) -> tuple[Assumption, ...]:
    """What classes that are not of this package say of themselves: bounds, moments, convexity."""
    foreign = {type(part).__name__ for part in _parts(problem) if not _of_the_package(part)}
    return tuple(Assumption(f"what {name} says of itself", "declared") for name in sorted(foreign))


def reaction_status(law: AbstractPerturbation) -> Status:
    """How it is known that the law moves continuously with the policy: proved where all it is made of proves it."""
    for part in _parts(law):
        unproved = isinstance(part, AbstractPolicyMap) and part.continuous is not True
        if unproved or isinstance(part, SampledPerturbation) or not _of_the_package(part):
            return "declared"
    return "proved"
