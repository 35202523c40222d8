"""Certificates as plain data, for tables, JSON and the command line."""

from typing import Any

import numpy as np

from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.certify import KINDS, certify
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.certificates.sharp import Sharp

PLAIN_VALUES = (
    "kappa",
    "gamma",
    "convexity",
    "mean_field_stable",
    "mean_step",
    "mean_square_step",
    "mean_square_step_error",
    "error_floor",
    "contraction_estimate",
)


def plain(value: Any) -> Any:
    """`value` as numbers, strings, lists and None that JSON can hold; infinities and NaN become strings."""
    if isinstance(value, np.ndarray):
        return [plain(item) for item in value.tolist()]
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | float | np.number):
        number = float(value)
        return number if np.isfinite(number) else str(number)
    return value


def certificate_row(certificate: Certificate) -> dict[str, Any]:
    """One certificate as plain data."""
    row: dict[str, Any] = {
        name: plain(getattr(certificate, name))
        for name in (
            "kind",
            "applicable",
            "holds",
            "exists",
            "existence",
            "existence_status",
            "lhs",
            "rhs",
            "margin",
            "rate",
        )
    }
    row["missing"] = list(certificate.missing)
    row["weights"] = plain(certificate.weights)
    row["contributions"] = plain(certificate.contributions)
    row["assumptions"] = [{"text": item.text, "status": item.status} for item in certificate.assumptions]
    row["values"] = {name: plain(certificate.values[name]) for name in PLAIN_VALUES if name in certificate.values}
    row["text"] = str(certificate)
    return row


def verdict_rows(
    problem: PerformativeProblem,
    kinds: tuple[str | AbstractCertificateKind, ...] = KINDS,
    *,
    batch: int = 1,
    key: Any = None,
) -> list[dict[str, Any]]:
    """Every certificate of a problem as plain data, one dict a kind.

    Args:
        kinds: which ones, by name or as objects. batch, key: of the sharp one where it is given by name.

    Returns:
        Dicts with "kind", "applicable", "missing", "holds", "exists", "existence", "existence_status", "lhs", "rhs",
        "margin", "rate", "weights", "contributions", "assumptions", "values" and "text".
    """
    sharp = Sharp(batch=batch, key=key)
    return [certificate_row(certify(problem, sharp if kind == sharp.name else kind)) for kind in kinds]
