"""From a fit to a decision: the stable policy, how far the logs pin it down, what it costs, whether it attracts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import fail
from perfcontrol.evaluate import expected_cost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import AbstractSolver, Result, solve
from perfcontrol.theory import Certificate, Sharp, certify


@dataclass(frozen=True, eq=False)
class Interval:
    """What the fit says, and the ends of an interval that holds the truth as often as was asked for."""

    estimate: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True, eq=False)
class Decision:
    """A stable policy from logs with its uncertainty, as `Fit.decide` makes it.

    Attributes:
        M: the stable policy of the fitted problem, free parameters: what to deploy.
        level: of the intervals.
        policy: of the plant's own stable policy, entry by entry, `.estimate .low .high`.
        cost: of what that policy costs once the plant has reacted.
        deployed_cost: of what M costs once it is deployed.
        solved: share of the ensemble in which a stable policy was found.
        certified: share of the ensemble in which one was found and the certificate holds.
        ensemble: the resampled problems, stacked.
        policies: (k, ...), their stable policies; NaN where none was found.
        costs: (k,), what these cost in their own world; NaN likewise.
        certificate: that of the fitted problem.
    """

    M: np.ndarray
    level: float
    policy: Interval
    cost: Interval
    deployed_cost: Interval
    solved: float
    certified: float
    ensemble: PerformativeProblem
    policies: np.ndarray
    costs: np.ndarray
    certificate: Certificate

    def __str__(self) -> str:
        size = float(np.linalg.norm(self.M))
        widths = np.linalg.norm(self.policy.high - self.policy.low) / 2
        level = f"{100 * self.level:g} %"
        said = [
            f"The stable policy has norm {size:.3g}; half-widths of its {level} intervals have norm {widths:.2g}.",
            f"The plant's own costs {_shown(self.cost)} once it has reacted; this one, {_shown(self.deployed_cost)}.",
            f"Of {len(self.costs)} resampled plants, {100 * self.solved:.3g} % have a stable policy that was found, "
            f"and for {100 * self.certified:.3g} % the certificate '{self.certificate.kind}' holds.",
        ]
        if self.solved < 1:
            said.append("The intervals speak of those with a stable policy alone.")
        return " ".join(said)


def _shown(interval: Interval) -> str:
    return f"{float(interval.estimate):.4g} ({float(interval.low):.4g} to {float(interval.high):.4g})"


def decide(
    problem: PerformativeProblem,
    ensemble: PerformativeProblem,
    solver: AbstractSolver,
    certificate: Any,
    level: float,
    key: Any,
) -> Decision:
    """See `Fit.decide`; `problem` is the fitted one."""
    if not (isinstance(level, int | float) and 0 < level < 1):
        raise fail("level", repr(level), "be a number between 0 and 1", "Pass for example level=0.95.")
    M = solve(problem, solver, key=key).M
    verdict = _certificate(problem, certificate, M)
    members = _members(ensemble)
    policies, costs, deployed = np.full((len(members), *M.shape), np.nan), np.full(len(members), np.nan), []
    certified = 0
    for i, member in enumerate(members):
        deployed.append(float(expected_cost(member, M)))
        solution = solve(member, solver, key=key, throw=False)
        if solution.result != Result.success:
            continue
        policies[i], costs[i] = np.asarray(solution.M), float(expected_cost(member, solution.M))
        certified += _certificate(member, certificate, solution.M).holds is True
    found = np.isfinite(costs)
    if not found.any():
        remedy = "Log more episodes, or pass a smaller feasible_set."
        raise fail("logs", "no resampled plant with a stable policy", "tell a plant that has one", remedy)
    return Decision(
        np.asarray(M),
        level,
        _interval(np.asarray(M), policies[found], level),
        _interval(np.asarray(expected_cost(problem, M)), costs[found], level),
        _interval(np.asarray(expected_cost(problem, M)), np.array(deployed), level),
        float(found.mean()),
        certified / len(members),
        ensemble,
        policies,
        costs,
        verdict,
    )


def _members(ensemble: PerformativeProblem) -> Sequence[PerformativeProblem]:
    leaves, structure = jax.tree.flatten(ensemble)
    host = [np.asarray(leaf) for leaf in leaves]
    return [jax.tree.unflatten(structure, [jnp.asarray(leaf[i]) for leaf in host]) for i in range(len(host[0]))]


def _certificate(problem: PerformativeProblem, kind: Any, M: Any) -> Certificate:
    return certify(problem, Sharp(M=M, samples=0, pairs=0) if kind == "sharp" else kind)


def _interval(estimate: np.ndarray, draws: np.ndarray, level: float) -> Interval:
    """Between quantiles of the resampled values."""
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return Interval(estimate, np.asarray(low), np.asarray(high))
