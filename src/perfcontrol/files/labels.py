"""What a solution holds as labelled arrays."""

from typing import Any

import numpy as np

from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import Result, Solution


def policy_coordinates(problem: PerformativeProblem) -> dict[str, Any]:
    """Lags from 1, and names of signals where the system has them and the policy is not structured."""
    coordinates: dict[str, Any] = {"lag": np.arange(1, problem.memory + 1)}
    if problem.policy_shape == problem.lifted_shape:
        for axis, names in (("input", problem.system.input_names), ("state", problem.system.state_names)):
            if names is not None:
                coordinates[axis] = list(names)
    return coordinates


def dataset_of(problem: PerformativeProblem, solution: Solution, every: int = 1) -> Any:
    """A solution as an xarray Dataset: `policy`, `history` by step where the run recorded policies, the statistics."""
    import xarray

    axes = ("lag", "input", "state")
    data: dict[str, Any] = {"policy": (axes, np.asarray(solution.M))}
    coordinates = policy_coordinates(problem)
    history = solution.history
    if getattr(history, "shape", ())[1:] == solution.M.shape:
        data["history"] = (("step", *axes), np.asarray(history))
        coordinates["step"] = every * np.arange(len(history))
    for name, value in solution.stats.items():
        array = np.asarray(value)
        own = axes if array.shape == solution.M.shape else tuple(f"{name}_{i}" for i in range(array.ndim))
        data[name] = (own, array)
    attributes = {"result": Result[solution.result], "steps": int(solution.steps)}
    return xarray.Dataset(data, coords=coordinates, attrs=attributes)
