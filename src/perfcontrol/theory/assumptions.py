"""How a fact about a problem is known: proved, declared by the user, or estimated."""

from dataclasses import dataclass
from typing import Literal

Status = Literal["proved", "declared", "estimated"]


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
