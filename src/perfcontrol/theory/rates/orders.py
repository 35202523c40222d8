"""In which order of time should the sensitivities come? By the bound, and by exact evaluation.

By the bound Σ ε_k w_k the rearrangement inequality answers: largest ε on the smallest weight w is best. Whether the
problem itself agrees is another question: `compare_orders` rebuilds it for each order and evaluates it exactly.
"""

import itertools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from perfcontrol._checks import fail
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.certificates.certify import certify
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.stability.strong_stability import check_per_step


class OrderVerdict(NamedTuple):
    """best, worst: the sensitivities in the order with the smallest and the largest aggregate, (T,); best_value,
    worst_value: these aggregates."""

    best: np.ndarray
    worst: np.ndarray
    best_value: float
    worst_value: float


def order_by_bound(epsilon: Any, weights: Any) -> OrderVerdict:
    """Best and worst order of given sensitivities for fixed weights w_k, by the rearrangement inequality.

    Args:
        epsilon: (T,), in any order. weights: (T,), such as `Certificate.weights`.
    """
    epsilon = np.sort(check_per_step("epsilon", epsilon, None))
    weights = check_per_step("weights", weights, len(epsilon))
    ranks = np.argsort(np.argsort(weights, kind="stable"), kind="stable")
    worst = epsilon[ranks]
    best = epsilon[::-1][ranks]
    return OrderVerdict(best, worst, float(best @ weights), float(worst @ weights))


def compare_orders(
    build: Callable[[np.ndarray], PerformativeProblem],
    epsilon: Any,
    *,
    kind: str | AbstractCertificateKind = "sharp",
    orders: Iterable[Any] | None = None,
    seed: int = 0,
    **options: Any,
) -> list[dict[str, Any]]:
    """The rate of one certificate for several orders of the same sensitivities, smallest rate first.

    Args:
        build: sensitivities (T,) -> the problem that has them.
        epsilon: (T,), in any order.
        kind: of certificate, by name or as an object; "sharp" is the exact evaluation, here without its samples.
        orders: permutations of 0..T-1, positions in the sorted list; None: all of them up to T = 5, else ascending,
            descending and `seed`'s ten random ones.
        seed: of these.
        options: of the kind where it is given by name.

    Returns:
        One dict an order: "order" (T,), "epsilon" (T,), "rate" and "holds" (None where not applicable).
    """
    epsilon = np.sort(check_per_step("epsilon", epsilon, None))
    T = len(epsilon)
    if orders is None:
        if T <= 5:
            orders = list(itertools.permutations(range(T)))
        else:
            generator = np.random.default_rng(seed)
            random = [generator.permutation(T) for _ in range(10)]
            orders = [np.arange(T), np.arange(T)[::-1], *random]
    if kind == "sharp":
        options = {"samples": 0, "pairs": 0, **options}
    rows = []
    for order in orders:
        order = np.asarray(order)
        if sorted(order.tolist()) != list(range(T)):
            raise fail("orders", f"{order}", f"be permutations of 0..{T - 1}", "Name every position once.")
        certificate = certify(build(epsilon[order]), kind, **options)
        rows.append({"order": order, "epsilon": epsilon[order], "rate": certificate.rate, "holds": certificate.holds})
    return sorted(rows, key=lambda row: np.inf if row["rate"] is None else row["rate"])
