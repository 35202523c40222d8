"""The axes of many runs: every problem with every solver and every key; one row for each combination."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.dtypes
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import as_array, check_instance, fail
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.random_keys import rearranged
from perfcontrol.solvers.base import AbstractSolver
from perfcontrol.solvers.rows import Rows, Shared

EXAMPLE = "jax.random.split(jax.random.key(0), 100)"


def arranged(problems: Any, solvers: Any, M0: Any, keys: Any) -> tuple[tuple[int, ...], Shared, Rows]:
    """The axes of the answer, what rows choose from, and the rows in the order of those axes."""
    problems, many = _problems(problems)
    several = isinstance(solvers, list | tuple)
    some = [
        check_instance("solver", s, AbstractSolver, "pc.StablePoint()") for s in (solvers if several else [solvers])
    ]
    stacked = stack("solver", some, "Settings that are no numbers need a call each.")
    lead = (_length(problems),) * many + (len(some),) * several
    keys = _keys(keys, lead)
    axes = lead if keys is None else lead + keys.shape[-1:]
    place = np.unravel_index(np.arange(math.prod(axes)), axes) if axes else [np.zeros(1, int)]
    zero = np.zeros_like(place[0])
    key = None if keys is None else rearranged(keys, lambda words: _a_row(words, axes or (1,), 1))
    start = None if M0 is None else _starts(problems, M0, axes)
    rows = Rows(place[0] if many else zero, place[int(many)] if several else zero, key, start)
    return axes, Shared(problems, stacked), rows


def stack(name: str, things: Sequence[Any], remedy: str) -> Any:
    """Pytrees of one structure as one, with a leading axis on every array; what is no number must be the same."""
    if not things:
        raise fail(name, "an empty list", "hold at least one", "Pass one, or a list of them.")
    leaves, structures = zip(*(jax.tree.flatten(thing) for thing in things), strict=True)
    for place, structure in enumerate(structures):
        if structure != structures[0]:
            raise fail(name, f"one at place {place} that differs in more than numbers", "be alike", remedy)
    return jax.tree.unflatten(structures[0], [_stacked(name, column) for column in zip(*leaves, strict=True)])


def _stacked(name: str, column: Sequence[Any]) -> Any:
    if not any(eqx.is_array(leaf) for leaf in column) and all(leaf == column[0] for leaf in column):
        return column[0]
    shapes = {jnp.shape(leaf) for leaf in column}
    if len(shapes) > 1:
        raise fail(name, f"arrays of shapes {sorted(shapes)}", "be alike", "Pass those of each shape in a call.")
    return jnp.stack([jnp.asarray(leaf) for leaf in column])


def _problems(problems: Any) -> tuple[PerformativeProblem, bool]:
    """Problems with a leading axis on every array, and whether they are given as many."""
    if isinstance(problems, list | tuple):
        remedy = "Swept numbers belong in `params` of pc.Function, and the function must be the same object."
        return stack("problems", [check_problem(problem) for problem in problems], remedy), True
    problem = check_instance("problems", problems, PerformativeProblem, "pc.PerformativeProblem(...)")
    if not _is_stack(problem):
        return jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, problem), False
    lengths = {leaf.shape[:1] for leaf in jax.tree.leaves(eqx.filter(problem, eqx.is_array))}
    if len(lengths) > 1:
        raise fail(
            "problems",
            f"leading axes of lengths {sorted(lengths)}",
            "have one leading axis on every array",
            "Stack them by jax.vmap over what builds them, or pass a list.",
        )
    return problem, True


def _is_stack(problem: PerformativeProblem) -> bool:
    """Whether arrays have a leading axis: the law of x_0, which never varies in time, has one mean or several."""
    try:
        return eqx.filter_eval_shape(lambda law: law.mean, problem.initial_state).ndim != 1
    except Exception:  # a mean that cannot be computed from stacked arrays
        return True


def _length(problems: PerformativeProblem) -> int:
    return jax.tree.leaves(eqx.filter(problems, eqx.is_array))[0].shape[0]


def _keys(keys: Any, axes: tuple[int, ...]) -> Array | None:
    """Typed keys, with the axes of problems and solvers before their own where they have several."""
    if keys is None:
        return None
    if not isinstance(keys, jax.Array):
        raise fail("keys", type(keys).__name__, "be JAX random keys", f"Pass keys={EXAMPLE}.")
    if not jnp.issubdtype(keys.dtype, jax.dtypes.prng_key):
        if keys.dtype != jnp.uint32 or keys.ndim == 0:
            raise fail("keys", f"an array of {keys.dtype}", "be JAX random keys", f"Pass keys={EXAMPLE}.")
        keys = jax.random.wrap_key_data(keys)
    if keys.size == 0:
        raise fail("keys", f"shape {keys.shape}", "hold at least one", f"Pass keys={EXAMPLE}.")
    required = f"have shape (seeds,) or {(*axes, 'seeds')}"
    if keys.ndim <= 1:
        return keys
    if keys.ndim != len(axes) + 1 or any(k not in (1, a) for k, a in zip(keys.shape, axes, strict=False)):
        raise fail("keys", f"shape {keys.shape}", required, "Pass an axis of length 1 where keys are shared.")
    return jnp.broadcast_to(keys, (*axes, keys.shape[-1]))


def _starts(problems: PerformativeProblem, M0: Any, axes: tuple[int, ...]) -> np.ndarray:
    """A start for each row."""
    M0, shape = as_array("M0", M0), problems.policy_shape
    lead = M0.shape[: max(M0.ndim - len(shape), 0)]
    fits = M0.shape[len(lead) :] == shape and (
        not lead or (len(lead) == len(axes) and all(k in (1, a) for k, a in zip(lead, axes, strict=True)))
    )
    if not fits:
        raise fail(
            "M0",
            f"shape {M0.shape}",
            f"be one policy, {shape}, or have shape {(*axes, *shape)}",
            "Pass an axis of length 1 where starts are shared.",
        )
    return _a_row(np.asarray(M0), axes, len(shape)).astype(problems.dtype)


def _a_row(array: np.ndarray, axes: tuple[int, ...], own: int) -> np.ndarray:
    """One member for each row, of an array that has `own` axes for a member behind those of the answer."""
    shape = array.shape[-own:]
    return np.broadcast_to(array, (*axes, *shape)).reshape(-1, *shape)
