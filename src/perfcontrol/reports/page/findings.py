"""What a report is about: policies, costs, certificates, runs and paths of one problem, or why one is missing."""

import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from perfcontrol._checks import InputError
from perfcontrol.evaluate import Trajectories, estimate_cost, expected_cost, simulate
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import best_response, estimate_response
from perfcontrol.response.estimate import is_exact
from perfcontrol.solvers import RRM, PerformativeOptimum, Result, Solution, SolveError, StablePoint, solve
from perfcontrol.theory import KINDS, Certificate, PriceOfStability, Sharp, certify, price_of_stability

if TYPE_CHECKING:
    from perfcontrol.plotting.landscape import Landscape

STEPS = 200  # of paths of an infinite horizon
SAME = 1e-6  # relative distance up to which two policies are called the same
DEPLOYMENTS = 60  # of repeated minimisation, for the figure of its convergence
NOT_POSSIBLE = (InputError, SolveError, OverflowError, FloatingPointError)


class Cost(NamedTuple):
    """C_T(M; M) of one policy: exact, or a mean with its standard error."""

    value: float
    standard_error: float | None = None


@dataclass
class Findings:
    """All that the sections say. Parts that could not be had are absent, and `why_not` names them with the reason.

    runs: solutions that were given, by name; every: steps between the entries of their histories. policies: naive,
    stable, optimal as far as known, then those of the runs that are none of these; `same` says which one a run found.
    convergence: runs by name, with their histories. paths: of each policy in its own world. seconds: of each part.
    """

    problem: PerformativeProblem
    runs: dict[str, Solution]
    every: dict[str, int]
    seed: int
    samples: int
    exact: bool
    policies: dict[str, np.ndarray] = field(default_factory=dict)
    same: dict[str, str] = field(default_factory=dict)
    costs: dict[str, Cost] = field(default_factory=dict)
    price: PriceOfStability | None = None
    certificates: list[Certificate] = field(default_factory=list)
    convergence: dict[str, Solution] = field(default_factory=dict)
    paths: dict[str, Trajectories] = field(default_factory=dict)
    landscape: "Landscape | None" = None
    why_not: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def key(self) -> Any:
        """The root of all randomness."""
        return jax.random.key(self.seed)

    def existence(self) -> Certificate | None:
        """The certificate that says most about existence: what is proved goes before what is declared or estimated."""
        order = ("proved", "declared", "estimated", None)
        known = [one for one in self.certificates if one.exists is not None]
        return min(known, key=lambda one: order.index(one.existence_status), default=None)


class Clock:
    """Runs the parts of a report one after the other, until the time is used up."""

    def __init__(self, found: Findings, seconds: float | int | None, progress: Callable[[str, float], None] | None):
        self.found, self.limit, self.progress = found, seconds, progress
        self.began = time.monotonic()

    @contextmanager
    def part(self, name: str, *, optional: bool = True) -> Any:
        """Yields whether there is time for it; what is not possible becomes the reason why it is missing."""
        began = time.monotonic()
        if optional and self.limit is not None and began - self.began > self.limit:
            self.found.why_not[name] = f"The {self.limit:g} s that were allowed were used up before it was begun."
            yield False
            return
        if self.progress is not None:
            self.progress(name, 0.0)
        try:
            yield True
        except NOT_POSSIBLE as error:
            self.found.why_not[name] = str(error)
        self.found.seconds[name] = time.monotonic() - began
        if self.progress is not None:
            self.progress(name, 1.0)


def gather(
    problem: PerformativeProblem,
    runs: dict[str, Solution],
    *,
    every: dict[str, int],
    seed: int,
    samples: int,
    seconds: float | int | None,
    progress: Callable[[str, float], None] | None,
) -> Findings:
    """Everything that the report says, as far as it is possible in the time."""
    found = Findings(problem, runs, every, seed, samples, is_exact(problem))
    clock = Clock(found, seconds, progress)
    (_exact_policies if found.exact else _sampled_policies)(found, clock)
    _given_policies(found)
    with clock.part("costs", optional=not found.exact) as now:
        if now:
            _costs(found)
    with clock.part("convergence") as now:
        if now:
            _convergence(found)
    with clock.part("paths") as now:
        if now:
            truncation = None if problem.is_finite else STEPS
            for name, M in found.policies.items():
                drawn = simulate(problem, M, key=found.key, samples=samples, truncation=truncation)
                if bool(np.isfinite(np.asarray(drawn.cost)).all()):
                    found.paths[name] = drawn
                else:
                    found.why_not[f"paths of {name}"] = "They grow beyond what numbers of this precision hold."
    for kind in KINDS:
        with clock.part(f"certificate {kind}") as now:
            if now:
                found.certificates.append(certify(problem, _kind(found, kind)))
    with clock.part("landscape") as now:
        if now:
            _landscape(found)
    return found


def _exact_policies(found: Findings, clock: Clock) -> None:
    """By `price_of_stability`; where there is no stable policy, naive and optimal one alone."""
    problem, policies = found.problem, found.policies
    with clock.part("policies", optional=False):
        price = found.price = price_of_stability(problem)
        policies.update(naive=price.naive, stable=price.stable, optimal=price.optimal)
    if found.price is None:
        with clock.part("naive policy", optional=False):
            policies["naive"] = np.asarray(best_response(problem, problem.initial_policy()))
        with clock.part("optimal policy") as now:
            if now:
                policies["optimal"] = np.asarray(solve(problem, PerformativeOptimum()).M)


def _sampled_policies(found: Findings, clock: Clock) -> None:
    """By sample averages; the optimum last, since it takes longest."""
    problem, policies = found.problem, found.policies
    with clock.part("naive policy") as now:
        if now:
            policies["naive"] = np.asarray(estimate_response(problem, problem.initial_policy(), key=found.key).mean)
    with clock.part("stable policy") as now:
        if now:
            run = found.convergence["stable point, sampled"] = solve(problem, StablePoint(), key=found.key, throw=False)
            if run.result != Result.success:
                raise SolveError(Result[run.result], run)
            policies["stable"] = np.asarray(run.M)
    with clock.part("optimal policy") as now:
        if now:
            policies["optimal"] = np.asarray(solve(problem, PerformativeOptimum(), key=found.key).M)


def _given_policies(found: Findings) -> None:
    """The policies of the runs, unless they are known already."""
    for name, run in found.runs.items():
        M = np.asarray(run.M)
        for other, known in found.policies.items():
            if np.linalg.norm(M - known) <= SAME * max(float(np.linalg.norm(known)), np.finfo(float).tiny):
                found.same[name] = other
                break
        else:
            found.policies[name] = M


def _costs(found: Findings) -> None:
    """Exactly where moments are known; those of the price are taken from it."""
    price = found.price
    if price is not None:
        known = {"naive": price.cost_naive, "stable": price.cost_stable, "optimal": price.cost_optimal}
        found.costs.update({name: Cost(value) for name, value in known.items() if value is not None})
        if price.cost_naive is None:
            found.why_not["cost of naive"] = "The world that it makes is not mean-square stable: the cost is infinite."
    for name, M in found.policies.items():
        if name in found.costs or f"cost of {name}" in found.why_not:
            continue
        try:
            found.costs[name] = Cost(float(expected_cost(found.problem, M))) if found.exact else _sampled(found, M)
        except NOT_POSSIBLE as error:
            found.why_not[f"cost of {name}"] = str(error)


def _sampled(found: Findings, M: np.ndarray) -> Cost:
    truncation = None if found.problem.is_finite else STEPS
    estimate = estimate_cost(found.problem, M, key=found.key, samples=max(found.samples, 2), truncation=truncation)
    return Cost(float(estimate.mean), float(estimate.standard_error))


def _convergence(found: Findings) -> None:
    if found.exact:
        for name, solver in (("repeated minimisation", RRM(max_steps=DEPLOYMENTS)), ("stable point", StablePoint())):
            found.convergence[name] = solve(found.problem, solver, throw=False)
    for name, run in found.runs.items():
        if np.shape(run.history)[1:] == found.problem.policy_shape:
            found.convergence[name] = run
        else:
            found.why_not[f"convergence of {name}"] = "Its history holds no iterates: `record` was given to pc.solve."


def _kind(found: Findings, kind: str) -> Any:
    """The kind to certify with: the sharp one is told the stable policy, so that it does not look for it again."""
    stable = found.policies.get("stable")
    if kind != Sharp.name or not found.exact:
        return kind
    return Sharp(M=stable, by_time=True)


def _landscape(found: Findings) -> None:
    from perfcontrol.plotting.landscape import landscape

    if found.price is None:
        reason = "the three policies are known only by samples" if not found.exact else found.why_not["policies"]
        found.why_not["landscape"] = f"It needs the exact costs of all three policies: {reason}"
        return
    found.landscape = landscape(found.problem, found.price)
