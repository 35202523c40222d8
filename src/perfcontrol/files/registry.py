"""Which public names may stand in a file, one row for each; the constructors say the rest.

A table of a file is a call: `type` names a public class, the other keys are its arguments. What an argument may hold is
read from its annotation (`Any` is an array); a row says only what annotations leave open, and where an object keeps an
argument under another name.
"""

import functools
import inspect
import re
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Union

import perfcontrol.costs as costs
import perfcontrol.experiments as experiments
import perfcontrol.perturbations as perturbations
import perfcontrol.policy_maps as policy_maps
import perfcontrol.random_vectors as random_vectors
import perfcontrol.sets as sets
import perfcontrol.solvers as solvers
import perfcontrol.systems as systems
from perfcontrol._linalg import Diagonal
from perfcontrol.costs.functions import AbstractStageFunction
from perfcontrol.perturbations.dense import WHITE_LAWS
from perfcontrol.perturbations.scalar_laws import SCALAR_LAWS
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors.stochastic_volatility import VOLATILITIES
from perfcontrol.response import SampleAverage
from perfcontrol.solvers.averaging import COVARIANCES

Law = random_vectors.AbstractRandomVector
ArrayOrMap = Union[Any, policy_maps.AbstractPolicyMap]  # noqa: UP007 - Any takes no |


@dataclass(frozen=True)
class Argument:
    """What a key may hold: alternatives, each a type, `Any` for an array, a `Literal`, or a list of one of these."""

    name: str
    alternatives: tuple[Any, ...]
    required: bool
    default: Any
    about: str


@dataclass(frozen=True)
class Row:
    """A public constructor that a file may name.

    takes: alternatives of arguments whose annotation says too little. kept: where an object holds an argument, if not
    under its name: an attribute (dotted), or a function of the object. python: arguments that only Python can give.
    """

    build: Callable[..., Any]
    gives: type
    takes: Mapping[str, Any] = field(default_factory=dict)
    kept: Mapping[str, str | Callable[[Any], Any]] = field(default_factory=dict)
    python: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """As a file says it: the public name without `pc.`"""
        return self.build.__qualname__

    @functools.cached_property
    def arguments(self) -> dict[str, Argument]:
        """The keys of the table, from the signature and the docstring."""
        called = self.build.__init__ if inspect.isclass(self.build) else self.build
        hints = typing.get_type_hints(called)
        described = descriptions(self.build.__doc__ or "")
        found = {}
        for name, parameter in inspect.signature(self.build).parameters.items():
            if name not in self.python:
                needed = parameter.default is parameter.empty
                default = None if needed else parameter.default
                kinds = alternatives(self.takes.get(name, hints.get(name, Any)))
                found[name] = Argument(name, kinds, needed, default, described.get(name, ""))
        return found


def alternatives(annotation: Any) -> tuple[Any, ...]:
    """The members of a union, without None."""
    members = typing.get_args(annotation) if typing.get_origin(annotation) in _UNIONS else (annotation,)
    return tuple(member for member in members if member is not type(None))


_UNIONS = (Union, type(int | str))


def descriptions(docstring: str) -> dict[str, str]:
    """What a docstring says of each argument."""
    _, _, after = inspect.cleandoc(docstring).partition("Args:\n")
    found = re.findall(r"^    (\w+): ((?:.|\n(?:     |$))*)", after.split("\n\n")[0], re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in found}


def _row(build: Any, gives: Any = None, **settings: Any) -> Row:
    return Row(build, build if gives is None else gives, **settings)


@dataclass(frozen=True)
class DesignedGain:
    """A gain of which a file gives the weights alone; the system of the same file does the rest."""

    Q: Any
    R: Any


def design_gain(Q: Any, R: Any) -> DesignedGain:
    """What a file says of `pc.design_gain`.

    Args:
        Q: (n, n) weight of the state, symmetric.
        R: (m, m) weight of the input, symmetric positive definite.
    """
    return DesignedGain(Q, R)


_SOLVER = {"kept": {"max_steps": "limit"}}

ROWS = {
    row.name: row
    for row in (
        _row(systems.LinearSystem.diagonal, systems.LinearSystem, kept={"a": "A.values", "b": "B.values"}),
        _row(systems.LinearSystem, takes={"state_names": list[str], "input_names": list[str]}),
        _row(design_gain, DesignedGain),
        # laws of noise and initial state
        _row(random_vectors.Constant),
        _row(random_vectors.Empirical),
        _row(random_vectors.Gaussian, kept={"mean": "centre", "covariance": "spread"}),
        _row(random_vectors.Linear),
        _row(random_vectors.LogNormal, kept={"mean": "log_mean", "covariance": "log_covariance"}),
        _row(random_vectors.Rademacher, kept={"mean": "centre"}),
        _row(random_vectors.Sequence),
        _row(
            random_vectors.StochasticVolatility,
            takes={"volatility": Literal[VOLATILITIES]},
            kept={"stocks": "alike.size"},
        ),
        _row(
            random_vectors.TruncatedGaussian,
            kept={"mean": "centre", "covariance": "spread", "bound": "radius"},
        ),
        _row(random_vectors.Uniform),
        # how a quantity depends on the policy
        _row(policy_maps.Affine),
        _row(policy_maps.Norm),
        # perturbations
        _row(perturbations.NoPerturbation),
        _row(
            perturbations.DirectionalPerturbation,
            takes={"scale": ArrayOrMap, "mean": ArrayOrMap, "law": Literal[tuple(SCALAR_LAWS)]},
            kept={"mean": "mean_map"},
        ),
        _row(
            perturbations.DensePerturbation,
            takes={"scale": ArrayOrMap, "mean": ArrayOrMap, "law": Literal[WHITE_LAWS] | Law},
            kept={"mean": "mean_map", "law": lambda part: part.kind if part.law is None else part.law},
        ),
        _row(perturbations.FinitePerturbation, takes={"probabilities": ArrayOrMap}),
        _row(perturbations.StockPerturbation),
        # costs
        _row(costs.QuadraticCost),
        _row(costs.ConvexCost, takes={"function": AbstractStageFunction}),
        _row(costs.Huber),
        _row(costs.LogCosh),
        _row(costs.OneSidedQuadratic, takes={"side": Literal["above", "below"]}),
        _row(costs.LinearExponential),
        # feasible sets and structures
        _row(sets.Unconstrained),
        _row(sets.FrobeniusBall, kept={"radius": "limit"}),
        _row(sets.SpectralBall, kept={"radius": "limit"}),
        _row(sets.RowSum),
        _row(sets.RowSimplex),
        _row(sets.Box),
        _row(sets.Support),
        _row(sets.Intersection, takes={"sets": list[sets.AbstractSet]}),
        _row(sets.FullStructure),
        _row(sets.RepeatedBlock),
        # solvers and their parts
        _row(
            solvers.RSGD,
            takes={
                "step_size": Union[Any, solvers.InverseStep, solvers.PowerStep],  # noqa: UP007
                "gradient": solvers.AbstractGradient,
                "schedule": solvers.Greedy | solvers.Lazy,
            },
            python=("transform",),
        ),
        _row(solvers.RRM, **_SOLVER),
        _row(solvers.StablePoint, kept={"max_steps": "limit", "rescue": "rescues"}),
        _row(solvers.PerformativeOptimum, **_SOLVER),
        _row(solvers.Continuation, **_SOLVER),
        _row(SampleAverage),
        _row(solvers.Average, takes={"covariance": Literal[COVARIANCES]}),
        _row(solvers.InverseStep),
        _row(solvers.PowerStep),
        _row(solvers.Pathwise),
        _row(solvers.Exact),
        _row(solvers.EstimatedDynamics),
        _row(solvers.TwoPoint),
        _row(solvers.Greedy),
        _row(solvers.Lazy),
        # problems
        _row(
            PerformativeProblem,
            takes={"noise": Law, "initial_state": Union[Any, Law], "gain": Union[Any, DesignedGain]},  # noqa: UP007
        ),
        _row(experiments.stock_market, PerformativeProblem),
        _row(experiments.market, PerformativeProblem),
    )
}

# Public classes that no file can name, and why.
IN_PYTHON_ONLY = {
    "Function": "holds a Python function: use pc.Affine(offset, slope) or pc.Norm(offset, weight)",
    "SampledPerturbation": "holds a Python function: use a family with known moments, such as pc.DensePerturbation",
}


def rows_giving(kind: type) -> list[Row]:
    """The rows whose objects are of a kind."""
    return [row for row in ROWS.values() if issubclass(row.gives, kind)]


def parts_of(argument: Argument) -> list[Row]:
    """The rows whose objects an argument takes."""
    kinds = [kind for kind in argument.alternatives if isinstance(kind, type) and kind not in (bool, int, float, str)]
    return [row for kind in kinds for row in rows_giving(kind)]


def plain_type(rows: list[Row]) -> str | None:
    """The type of a table that says none: the one class, or the one whose name begins all others."""
    first = min(rows, key=lambda row: len(row.name))
    return first.name if all(row.name.startswith(first.name) for row in rows) else None


def row_of(part: Any) -> Row | None:
    """The row that an object is written by; None where there is none."""
    if isinstance(part, systems.LinearSystem) and isinstance(part.A, Diagonal) and isinstance(part.B, Diagonal):
        return ROWS["LinearSystem.diagonal"]
    return next((row for row in ROWS.values() if row.build is type(part)), None)
