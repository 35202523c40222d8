"""What figures are given: axes, policies by name, paths by name."""

import math
from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from perfcontrol._checks import fail
from perfcontrol.evaluate import Trajectories, simulate
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.solvers import Solution
from perfcontrol.theory import PriceOfStability

PANEL = 2.9, 2.1  # inches
STEPS = 100  # of an infinite horizon that are shown unless told otherwise


def panels(ax: Any, count: int, size: tuple[float, float] = PANEL, columns: int = 3, **shared: Any) -> list[Axes]:
    """`count` axes: those given, or those of a new figure.

    Raises:
        InputError: another number of axes.
    """
    if ax is not None:
        given = list(np.asarray(ax, dtype=object).reshape(-1))
        if len(given) != count or not all(isinstance(one, Axes) for one in given):
            required = "be one Matplotlib axes" if count == 1 else f"be {count} Matplotlib axes"
            remedy = f"Pass plt.subplots({'' if count == 1 else f'1, {count}'})[1], or leave it out."
            raise fail("ax", f"{len(given)} of {type(given[0]).__name__ if given else 'nothing'}", required, remedy)
        return given
    columns = min(columns, count)
    rows = math.ceil(count / columns)
    width, height = size
    _, grid = plt.subplots(
        rows, columns, figsize=(width * columns, height * rows), squeeze=False, layout="constrained", **shared
    )
    for spare in grid.flat[count:]:
        spare.remove()
    return list(grid.flat[:count])


def as_policies(problem: PerformativeProblem, policies: Any) -> dict[str, np.ndarray]:
    """Policies by name, from a mapping, `pc.price_of_stability(problem)`, one solution or one array.

    Raises:
        InputError: none at all, or a policy that does not fit the problem.
    """
    check_problem(problem)
    if isinstance(policies, PriceOfStability):
        policies = {name: getattr(policies, name) for name in ("naive", "stable", "optimal")}
    elif not isinstance(policies, Mapping):
        policies = {"policy": policies}
    if not policies:
        raise fail(
            "policies", "none", "be at least one policy", "Pass {'stable': M}, or pc.price_of_stability(problem)."
        )
    return {
        str(name): np.asarray(problem.check_policy("policies", M.M if isinstance(M, Solution) else M))
        for name, M in policies.items()
    }


def as_paths(
    problem: PerformativeProblem, policies: Any, key: Any, samples: int, truncation: int | None
) -> dict[str, Trajectories]:
    """Simulated paths by name: what is given as such, and those of each policy in the world that it makes itself."""
    check_problem(problem)
    if isinstance(policies, Trajectories):
        policies = {"policy": policies}
    named = policies if isinstance(policies, Mapping) else {}
    given = {str(name): paths for name, paths in named.items() if isinstance(paths, Trajectories)}
    if given and len(given) == len(named):
        return given
    others = {name: M for name, M in named.items() if str(name) not in given} if named else policies
    if truncation is None and not problem.is_finite:
        truncation = STEPS
    simulated = {
        name: simulate(problem, M, key=key, samples=samples, truncation=truncation)
        for name, M in as_policies(problem, others).items()
    }
    order = [str(name) for name in named] if named else list(simulated)
    return {name: (given | simulated)[name] for name in order}


def state_names(problem: PerformativeProblem) -> list[str]:
    """Of the system, or x[0], x[1], ..."""
    return list(problem.system.state_names or (f"x[{i}]" for i in range(problem.state_size)))


def input_names(problem: PerformativeProblem) -> list[str]:
    """Of the system, or u[0], u[1], ..."""
    return list(problem.system.input_names or (f"u[{i}]" for i in range(problem.input_size)))


def plain(name: str) -> str:
    """A user's name as it stands, and not as mathematics."""
    return name.replace("$", r"\$")
