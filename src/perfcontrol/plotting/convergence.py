"""Convergence: how far the iterates of several runs are from a policy, step by step."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from perfcontrol._checks import check_integer, fail
from perfcontrol.plotting.style import looks, styled
from perfcontrol.plotting.subjects import panels, plain
from perfcontrol.solvers import Result, Solution

SHORT = 100  # steps up to which the axis is linear


def plot_convergence(solutions: Any, reference: Any = None, *, every: Any = 1, ax: Any = None) -> Axes:
    """Distance ‖M_n - reference‖_F of the iterates of several runs, against the step; where a run failed, a cross.

    Of a batch of runs (a solution of `vmap`, over keys for example) the median and the band from 10 to 90 %.

    Args:
        solutions: one `Solution`, or several by name, with iterates as their history (`record` left out).
        reference: a policy, such as the stable one; None for what the first run that succeeded found, in which its own
            last steps vanish.
        every: as it was given to `pc.solve`; by name where it was not the same for all.
        ax: Matplotlib axes; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: no solutions, other histories than iterates, no reference and no run that succeeded.
    """
    named = as_solutions(solutions)
    target = _reference(named, reference)
    strides = every if isinstance(every, Mapping) else dict.fromkeys(named, every)
    styles = looks(named)
    with styled():
        axes = panels(ax, 1, (4.2, 2.8))[0]
        longest = 0
        for name, solution in named.items():
            stride = check_integer("every", strides.get(name, 1), 1)
            errors, ended = distances(name, solution, target, stride)
            n = stride * np.arange(errors.shape[-1])
            longest = max(longest, int(n[-1]))
            look = styles[name]
            style: Any = {"color": look.colour, "linestyle": look.line}
            middle = np.quantile(errors, 0.5, axis=0)
            if len(errors) > 1:
                axes.fill_between(
                    n, *np.quantile(errors, [0.1, 0.9], axis=0), color=look.colour, alpha=0.16, linewidth=0
                )
            mark = {"marker": look.mark, "markersize": 3.5} if len(n) <= 30 else {}
            axes.plot(n, np.where(middle > 0, middle, np.nan), label=plain(name), **style, **mark)
            if not ended:
                last = np.flatnonzero(middle > 0)[-1:]
                axes.plot(n[last], middle[last], color=look.colour, marker="x", markersize=8, markeredgewidth=2)
        axes.set_yscale("log")
        if longest > SHORT:
            axes.set_xscale("symlog", linthresh=1, linscale=0.3)
            axes.set_xlim(left=0)
        else:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel("step $n$")
        axes.set_ylabel(r"$\|M_n - M\|_F$" if reference is not None else "distance to the last policy")
        if len(named) > 1:
            axes.legend()
    return axes


def as_solutions(solutions: Any) -> dict[str, Solution]:
    """Solutions by name.

    Raises:
        InputError: none, or something else.
    """
    named = dict(solutions) if isinstance(solutions, Mapping) else {"run": solutions}
    for value in named.values():
        if not isinstance(value, Solution):
            remedy = "Pass {'RRM': pc.solve(problem, pc.RRM(), throw=False)}."
            raise fail("solutions", type(value).__name__, "be solutions of pc.solve, by name", remedy)
    if not named:
        raise fail("solutions", "none", "be at least one solution", "Pass {'RRM': solution}.")
    return {str(name): value for name, value in named.items()}


def _reference(named: dict[str, Solution], reference: Any) -> np.ndarray:
    if reference is not None:
        return np.asarray(reference.M if isinstance(reference, Solution) else reference)
    for solution in named.values():
        if np.ndim(solution.steps) == 0 and solution.result == Result.success:
            return np.asarray(solution.M)
    raise fail("reference", "None, and no run that succeeded", "be a policy", "Pass reference=M, the stable policy.")


def distances(name: str, solution: Solution, target: np.ndarray, every: int) -> tuple[np.ndarray, bool]:
    """‖M_n - target‖_F of each run, (runs, records), up to where the longest ended, and whether all ended well."""
    history = solution.history
    runs = np.shape(solution.steps)
    shape = np.shape(history) if isinstance(history, np.ndarray) or hasattr(history, "shape") else ()
    if shape[len(runs) + 1 :] != target.shape or len(shape) != len(runs) + 1 + target.ndim:
        required = f"hold iterates of shape {target.shape} as history"
        raise fail("solutions", f"a history of shape {shape} in {name!r}", required, "Leave `record` out of pc.solve.")
    kept = np.asarray(history).reshape(-1, shape[len(runs)], *target.shape)
    axes = tuple(range(2, kept.ndim))
    errors = np.sqrt(np.sum((kept - target) ** 2, axis=axes))
    last = int(np.max(np.asarray(solution.steps))) // every + 1
    ended = bool(np.all(np.asarray(solution.result == Result.success)))
    return errors[:, : max(last, 1)], ended
