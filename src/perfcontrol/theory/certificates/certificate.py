"""What a certificate says: whether it applies, whether it holds, by how much, and how each fact in it is known."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from perfcontrol.theory.assumptions import Assumption, Status


@dataclass(frozen=True)
class Certificate:
    """The verdict of one certificate on one problem.

    Attributes:
        kind: its name.
        verdict: one sentence.
        applicable: whether its assumptions can be met at all; if not, `holds`, `lhs`, `rhs` and `rate` are None. Not
            applicable never means "does not hold".
        missing: what keeps it from being applicable.
        holds: True where this certificate proves (sharp: finds) that the best response Φ contracts.
        exists: whether a performatively stable policy exists: True, False or None (unknown).
        existence: why.
        existence_status: how that is known: "proved", "declared" (it rests on the user's word) or "estimated".
        lhs: the left side; it holds where lhs < rhs.
        rhs: the right side.
        rate: its bound of the contraction rate of Φ (sharp: the local rate itself).
        weights: (T,), what one unit of ε_t adds to lhs: the propagation and aggregation of sensitivities; None for
            kinds that do not split that way.
        contributions: (T,), ε_t times weights; of the sharp kind what the reaction of each Δ_t adds to the rate
            (`pc.Sharp(by_time=True)`). None where the kind does not split that way.
        assumptions: what the verdict rests on.
        values: further numbers, by name.
        notes: remarks, in sentences.
    """

    kind: str
    verdict: str
    applicable: bool
    missing: tuple[str, ...] = ()
    holds: bool | None = None
    exists: bool | None = None
    existence: str = "nothing is known about existence"
    existence_status: Status | None = None
    lhs: float | None = None
    rhs: float | None = None
    rate: float | None = None
    weights: np.ndarray | None = None
    contributions: np.ndarray | None = None
    assumptions: tuple[Assumption, ...] = ()
    values: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def margin(self) -> float | None:
        """rhs - lhs: positive where the certificate holds."""
        if self.lhs is None or self.rhs is None:
            return None
        return self.rhs - self.lhs

    def __str__(self) -> str:
        sentences = [self.verdict, *self.notes, self._existence()]
        if self.assumptions:
            sentences.append("It rests on: " + "; ".join(str(item) for item in self.assumptions) + ".")
        return " ".join(sentences)

    def _existence(self) -> str:
        verdict = {True: "A stable policy exists", False: "No stable policy exists", None: "Existence is open"}
        if self.exists is None:
            return f"{verdict[None]}: {self.existence}."
        return f"{verdict[self.exists]} ({self.existence_status}): {self.existence}."
