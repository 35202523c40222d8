"""The interface of a kind of certificate: frozen settings that, given a problem, answer with a `Certificate`."""

import abc
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption, weakest
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.existence import Existence


@dataclass(frozen=True, kw_only=True)
class AbstractCertificateKind(abc.ABC):
    """What `pc.certify` takes. A subclass is a frozen dataclass whose fields are its settings.

    name: the shorthand for it. title: how a sentence about its verdict begins. endless: whether it is for infinite
    horizons, too.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    endless: ClassVar[bool] = False

    @abc.abstractmethod
    def assess(self, problem: PerformativeProblem) -> Certificate:
        """The verdict on one problem."""

    def sentence(self, holds: bool, numbers: str, rate: float) -> str:
        """The verdict in words; `numbers` reads "left < right". Here for a sufficient condition."""
        if holds:
            return (
                f"{self.title} holds ({numbers}): each round of repeated minimisation multiplies the distance to the "
                f"stable policy by at most {rate:.4g}."
            )
        return f"{self.title} does not hold ({numbers}); it is sufficient, not necessary, so nothing follows from that."

    def refuse(self, missing: list[str], exists: Existence) -> Certificate:
        """The certificate of a problem that does not meet the assumptions, with what is missing."""
        reasons = "; ".join(missing)
        verdict = f"{self.title} is not applicable here, which says nothing against the problem: {reasons}."
        return Certificate(
            self.name, verdict, False, tuple(missing), assumptions=exists.assumptions, **_existence_fields(exists)
        )

    def conclude(
        self,
        lhs: float,
        rhs: float,
        exists: Existence,
        assumptions: tuple[Assumption, ...],
        *,
        contraction: bool = True,
        weights: np.ndarray | None = None,
        contributions: np.ndarray | None = None,
        values: dict[str, Any] | None = None,
        notes: tuple[str, ...] = (),
    ) -> Certificate:
        """The certificate that holds where lhs < rhs; `contraction`: whether that proves Φ to contract the set."""
        holds = lhs < rhs
        rate = lhs / rhs if rhs > 0 else np.inf
        if holds and contraction and exists.exists is None:
            exists = Existence(True, "Φ is a contraction of a closed set", assumptions)
        return Certificate(
            self.name,
            self.sentence(holds, f"{lhs:.4g} {'<' if holds else '>='} {rhs:.4g}", rate),
            True,
            holds=holds,
            lhs=lhs,
            rhs=rhs,
            rate=rate,
            weights=weights,
            contributions=contributions,
            assumptions=tuple(dict.fromkeys((*assumptions, *exists.assumptions))),
            values=values or {},
            notes=notes,
            **_existence_fields(exists),
        )


def _existence_fields(exists: Existence) -> dict[str, Any]:
    status = None if exists.exists is None else weakest(exists.assumptions)
    return {"exists": exists.exists, "existence": exists.reason, "existence_status": status}
