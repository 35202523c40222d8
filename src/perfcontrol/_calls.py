"""Calls that do not fit a signature: the nearest keyword, or the missing argument with an example.

`explain_calls` wraps what a package exports, once, where `__all__` is made. A call that fits costs one more frame; only
after a TypeError is the signature looked at, and where the call does fit it, that TypeError goes on as it was.
"""

import difflib
import functools
import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx

from perfcontrol._checks import InputError, fail

# What other packages, and the letters of the paper, call the same thing.
SYNONYMS = {
    "start": "M0",
    "initial_policy": "M0",
    "policy": "M",
    "x0": "initial_state",
    "T": "horizon",
    "H": "memory",
    "K": "gain",
    "seed": "key",
    "rng": "key",
    "lr": "step_size",
    "learning_rate": "step_size",
    "iterations": "steps",
    "tol": "tolerance",
    "covariances": "covariance",
}

# How a missing argument may look; where a name is not here, its line of the docstring is shown.
EXAMPLES = {
    "system": "pc.LinearSystem(A, B)",
    "horizon": "40",
    "noise": "pc.Gaussian(np.zeros(n), np.eye(n))",
    "cost": "pc.QuadraticCost(Q, R)",
    "problem": "pc.PerformativeProblem(system=..., horizon=..., noise=..., cost=...)",
    "solver": "pc.StablePoint()",
    "M": "problem.initial_policy()",
    "deployed": "problem.initial_policy()",
    "Q": "np.eye(n)",
    "R": "np.eye(m)",
    "A": "np.eye(n)",
    "B": "np.eye(n, m)",
    "covariance": "np.eye(n)",
    "radius": "1.0",
    "low": "-1.0",
    "high": "1.0",
    "step_size": "pc.InverseStep(phi1, phi2)",
    "steps": "1000",
    "sets": "[pc.RowSum(1.0), pc.Box(0.0, 1.0)]",
    "law": "pc.Gaussian(np.zeros(n), np.eye(n))",
    "function": "lambda t, x, u: x @ x + u @ u",
    "sampler": "lambda key, M: jax.random.normal(key, (T, n, n))",
}


class CallError(InputError, TypeError):
    """A call with an unknown, a missing or a repeated argument: an InputError, and Python's TypeError as well."""


def explain_calls(module: str, namespace: dict[str, Any], names: Iterable[str]) -> None:
    """Make the names that a module exports say what is wrong with a call."""
    namespace.update({name: explain_call(module, name, namespace[name]) for name in names})


def explain_call(module: str, name: str, value: Any) -> Any:
    """What stands for `value`, exported by a module under a name: the same, but saying what is wrong with a call.

    A function becomes a wrapper that belongs to `module`, so that it can be pickled; of a class only `__init__` is
    wrapped, so that the class stays what it is. What was wrapped before, or is neither, is returned as it is.
    """
    owner = f"{module.replace('perfcontrol', 'pc', 1)}.{name}"
    if inspect.isclass(value) and not issubclass(value, Exception | eqx.Enumeration):
        if not hasattr(vars(value).get("__init__"), "explains"):
            value.__init__ = _explained(owner, value.__init__, skip=1, docstring=value.__doc__)
    elif inspect.isfunction(value) and not hasattr(value, "explains"):
        value = _explained(owner, value, skip=0)
        value.__module__ = module
    return value


def _explained(owner: str, function: Callable, skip: int, docstring: str | None = None) -> Callable:
    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        try:
            return function(*arguments, **keywords)
        except TypeError:
            parameters = list(inspect.signature(function).parameters.values())[skip:]
            wrong = wrong_call(owner, parameters, arguments[skip:], keywords, docstring or function.__doc__)
            if wrong is None:
                raise
        raise wrong

    call.explains = owner  # type: ignore[attr-defined]
    return call


def wrong_call(
    owner: str,
    parameters: Sequence[inspect.Parameter],
    arguments: Sequence[Any],
    keywords: Mapping[str, Any],
    docstring: str | None = None,
) -> CallError | None:
    """The error about a call that does not fit the parameters; None for one that does."""
    known = [p.name for p in parameters if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    open_ended = any(p.kind is p.VAR_KEYWORD for p in parameters)
    positional = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    filled = positional[: len(arguments)]
    for name in keywords:
        if name not in known and not open_ended:
            return _error(*_unknown(owner, name, known, filled))
        if name in filled:
            return _error(
                name, "two values", f"be given to {owner} once", f"Position {filled.index(name) + 1} is it already."
            )
    if len(arguments) > len(positional):
        return _error(*_too_many(owner, known, positional, len(arguments), keywords))
    required = [p.name for p in parameters if p.default is p.empty and p.name in known]
    missing = [name for name in required if name not in filled and name not in keywords]
    if not missing:
        return None
    others = f", nor {_listed(missing[1:])}" if len(missing) > 1 else ""
    return _error(missing[0], f"nothing{others}", f"be given to {owner}", _how_to_give(missing[0], docstring))


def check_keywords(owner: str, given: Iterable[str], known: Sequence[str]) -> None:
    """Raise where a keyword is none that `owner` takes, with the nearest one that it does."""
    for name in given:
        if name not in known:
            raise _error(*_unknown(owner, name, known, ()))


def _error(name: str, got: str, required: str, remedy: str) -> CallError:
    return CallError(*fail(name, got, required, remedy).args)


def _unknown(owner: str, name: str, known: Sequence[str], filled: Sequence[str]) -> tuple[str, str, str, str]:
    takes = f"It takes {_listed(known)}." if known else "It takes none."
    synonym = SYNONYMS.get(name)
    near = [synonym] if synonym in known else difflib.get_close_matches(name, known, 1, 0.6)
    near += [candidate for candidate in known if candidate.startswith(name) and candidate not in near]
    near = [candidate for candidate in near if candidate not in filled] or near
    nearest = f": did you mean {' or '.join(f'`{c}`' for c in near)}? " if near else ". "
    return name, "a name that it does not know", f"be an argument of {owner}", f"Check the spelling{nearest}{takes}"


def _too_many(
    owner: str, known: Sequence[str], positional: Sequence[str], count: int, keywords: Iterable[str]
) -> tuple[str, str, str, str]:
    by_name = [name for name in known if name not in positional and name not in keywords]
    limit = len(positional)
    if by_name:
        first = by_name[0]
        got = f"{count} arguments by position, where {limit or 'none'} may stand"
        return first, got, f"be given to {owner} by name", f"Write {first}=..."
    required = f"be called with at most {limit} argument{'' if limit == 1 else 's'}"
    return owner.rpartition(".")[2], f"{count}", required, f"It takes {_listed(positional) or 'none'}."


def _how_to_give(name: str, docstring: str | None) -> str:
    if name in EXAMPLES:
        return f"Pass for example {name}={EXAMPLES[name]}."
    described = re.search(rf"^( +){name}: (.*(?:\n\1 +.*)*)", docstring or "", re.MULTILINE)
    return f"Pass {name}=..." + (f": {' '.join(described[2].split())}" if described else "")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)
