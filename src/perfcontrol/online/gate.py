"""The gate: which policies the model lets onto the plant."""

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from perfcontrol._checks import InputError, check_instance, fail
from perfcontrol._programs import Numbers
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate import expected_cost
from perfcontrol.evaluate.rollout import cut_off
from perfcontrol.evaluate.stationary import mean_square_radius
from perfcontrol.online.state import Limits
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import RSGD
from perfcontrol.theory import Sharp, certify, safe_step
from perfcontrol.theory.derivatives import obstacles
from perfcontrol.theory.precision import in_double


@dataclass(frozen=True, kw_only=True)
class Gate:
    """What a new policy must pass before a `Controller` deploys it, all of it by the model.

    Args:
        cost: its exact cost, the model reacting to it, is at most so many times that of the first policy; None: any.
        radius: the world that it makes stays mean-square stable, the second moments of its states shrinking by at
            least this factor a step; None: it need not. Only where nothing in the model varies in time. A
            policy passes, too, whose world is no worse in this than that of the last one.
        step: the step size η_n is at most `pc.safe_step`.
        certificate: the sharp certificate finds a stable policy, and the mean field of RSGD stable there.

    Raises:
        InputError: a factor or a radius that is no positive number, a switch that is none.
    """

    cost: float | None = 2.0
    radius: float | None = 1.0
    step: bool = True
    certificate: bool = True

    def __post_init__(self) -> None:
        for name in ("cost", "radius"):
            value = getattr(self, name)
            if value is not None and (
                isinstance(value, bool) or not (isinstance(value, int | float) and 0 < value < math.inf)
            ):
                raise fail(name, repr(value), "be a positive number", "Pass None to look away.")
        for name in ("step", "certificate"):
            if not isinstance(getattr(self, name), bool):
                raise fail(name, repr(getattr(self, name)), "be True or False", "Pass False to leave this check out.")

    def check(self, problem: PerformativeProblem, solver: RSGD) -> None:
        """Raise where the model does not tell what this gate asks for."""
        missing = obstacles(problem)
        asked = [
            f.name
            for f in fields(self)
            if getattr(self, f.name) and not (f.name == "radius" and endless(problem) is None)
        ]
        if missing and asked:
            remedy = f"Pass gate=pc.online.Gate({_off(asked)}), or gate=False."
            raise fail(
                "gate",
                f"a model of which too little is known ({'; '.join(missing)})",
                "be answerable by the model",
                remedy,
            )
        if self.step and solver.transform is not None:
            remedy = "Pass gate=pc.online.Gate(step=False)."
            raise fail("gate", "a solver whose steps are transformed", "know how long a step may be", remedy)

    def limits(self, problem: PerformativeProblem, solver: RSGD, M0: Numbers) -> Limits:
        """Settled once, for the model: the certificate and the safe step are costly.

        Raises:
            InputError: the first policy is not one to fall back on.
        """
        cost = None
        if self.cost is not None:
            first = predicted(problem, M0)
            if not math.isfinite(first):
                raise fail(
                    "M0",
                    "a policy of unbounded predicted cost",
                    "be safe to fall back on",
                    "Start nearer to one that is.",
                )
            cost = first + (self.cost - 1) * abs(first)
        finite, weight = cut_off(problem, solver.truncation)
        refusal = _refusal(finite) if self.certificate else None
        step = None
        if self.step and refusal is None:
            try:
                step = min(float(safe_step(finite, solver.batch)) / weight, float(np.finfo(float).max))
            except InputError as error:
                step, refusal = 0.0, f"no step is known to be safe: {error}"
        return Limits(cost, step, refusal)

    def refuses(
        self,
        problem: PerformativeProblem,
        unending: PerformativeProblem | None,
        limits: Limits,
        candidate: Numbers,
        deployed: Numbers,
        size: float,
    ) -> list[str]:
        """Why the candidate, reached by a step of that size, may not follow the deployed policy; empty if it may.

        `unending` is `endless(problem)`.
        """
        reasons = [] if limits.refusal is None else [limits.refusal]
        if limits.step is not None and limits.refusal is None and size > limits.step:
            reasons.append(f"its step size {size:.3g} is above the safe step {limits.step:.3g}")
        if limits.cost is not None and not (cost := predicted(problem, candidate)) <= limits.cost:
            reasons.append(f"its predicted cost {cost:.4g} is above the limit {limits.cost:.4g}")
        if self.radius is not None and unending is not None:
            radius = float(mean_square_radius(unending, candidate))
            if not (radius < self.radius or radius <= float(mean_square_radius(unending, deployed))):
                reasons.append(
                    f"its world has a mean-square radius of {radius:.4g}, and {self.radius:.4g} is the limit"
                )
        return reasons


def as_gate(value: Any) -> Gate | None:
    """`True` for the default gate, `False` for none."""
    if isinstance(value, bool):
        return Gate() if value else None
    return check_instance("gate", value, Gate, "pc.online.Gate()")


def _off(names: list[str]) -> str:
    return ", ".join(f"{name}={'None' if name in ('cost', 'radius') else 'False'}" for name in names)


@in_double
def predicted(problem: PerformativeProblem, M: Numbers) -> float:
    """The exact cost of M in the model that reacts to it; infinite where there is none."""
    try:
        return float(expected_cost(problem, M))
    except (InputError, OverflowError):
        return math.inf


def _refusal(problem: PerformativeProblem) -> str | None:
    """Why the sharp certificate lets no policy of this model pass."""
    certificate = certify(problem, Sharp(samples=0, pairs=0))
    if not certificate.applicable:
        return f"no stable policy is certified: {'; '.join(certificate.missing)}"
    if certificate.exists is False:
        return f"the model has no stable policy: {certificate.existence}"
    if not certificate.values["mean_field_stable"]:
        return "the mean field of RSGD is unstable at the stable policy of the model"
    return None


def endless(problem: PerformativeProblem) -> PerformativeProblem | None:
    """The same world over an infinite horizon; None where something in it varies in time."""
    if not problem.is_finite:
        return problem
    same = ("system", "noise", "memory", "perturbation", "feasible_set", "structure")
    parts: dict[str, Any] = {name: getattr(problem, name) for name in same}
    cost = QuadraticCost(np.eye(problem.state_size), np.eye(problem.input_size))  # the radius does not depend on it
    gain = problem.gain if problem.has_gain else 0
    try:
        return PerformativeProblem(horizon=math.inf, cost=cost, gain=gain, **parts)
    except InputError:
        return None
