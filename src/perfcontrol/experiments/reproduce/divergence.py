"""The unstable regime again: what cures its divergence, what does not, and where it begins."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import xarray

from perfcontrol.config import ReproduceSettings
from perfcontrol.experiments.reproduce.cases import UNSTABLE, Progress, problems_of
from perfcontrol.experiments.reproduce.laboratory import Laboratory, constant_step, diminishing_step, names_of
from perfcontrol.experiments.stock import HORIZON, ORDERS
from perfcontrol.theory import MeanSquareStability, mean_square_stability

SMALL_STEP = 0.1  # the smaller constant step, relative to the paper's
FLOOR_SAMPLES = 128  # sampled Jacobians behind the floor of the smaller step: within two per cent
SWEEP_FACTORS = (0.25, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
# Largest constant step (on the stage average) that is stable in mean square, default market, unstable regime: by the
# operator of `computed_thresholds` on 16,384 sampled Jacobians, within one per cent.
MEAN_SQUARE_THRESHOLDS = {"ascending": 0.0236, "random": 0.00898, "descending": 0.00461}


def cure_stage(
    lab: Laboratory, bounded: list[Laboratory], settings: ReproduceSettings, progress: Progress
) -> xarray.Dataset:
    """The unstable regime again: with a diminishing step, with a smaller one, and on the bounded simplex."""
    cases = UNSTABLE + np.arange(len(ORDERS))
    stream = np.arange(len(ORDERS) * settings.cure_seeds).reshape(len(ORDERS), -1)
    step = settings.step_size
    plans = {
        "diminishing": (lab, diminishing_step(step), settings.cure_steps),
        "smaller": (lab, constant_step(SMALL_STEP * step), settings.steps),
    }
    for place in bounded:
        plans["simplex"] = (place, constant_step(step), settings.steps)
    data: dict[str, Any] = {}
    total, before = sum(steps for *_, steps in plans.values()), 0
    for name, (place, rule, steps) in plans.items():

        def show(share: float, before: int = before, steps: int = steps) -> None:
            progress("what cures divergence", (before + share * steps) / total)

        errors = place.errors(cases, place.run(cases, 3, stream, rule, steps, show))
        data[name] = (("order", "seed", f"step_{name}"), errors[..., 1:])
        data[f"step_{name}"] = ((f"step_{name}",), np.arange(1, steps + 1))
        before += steps
    return xarray.Dataset(data, coords={"order": list(ORDERS), "seed": np.arange(settings.cure_seeds)})


def sweep_stage(lab: Laboratory, settings: ReproduceSettings, progress: Progress) -> xarray.Dataset:
    """Constant steps around the mean-square thresholds of the unstable regime: which runs do not come closer."""
    factors = np.asarray(SWEEP_FACTORS)
    grid = (len(ORDERS), len(factors), settings.sweep_seeds)
    stream = np.arange(math.prod(grid)).reshape(grid)
    threshold = mean_square_thresholds(settings, lab.exact)
    relative, result = np.empty(grid), np.empty(grid, dtype="<U9")
    for order in range(len(ORDERS)):

        def show(share: float, before: int = order) -> None:
            progress("where divergence begins", (before + share) / len(ORDERS))

        rules = [constant_step(threshold[order] * factor) for factor in factors]
        solution = lab.run(UNSTABLE + order, 4, stream[order], rules, settings.sweep_steps, show)
        error = lab.errors(UNSTABLE + order, solution)
        relative[order], result[order] = error[..., -1] / error[..., 0], names_of(solution)
    return xarray.Dataset(
        {
            "relative_error": (("order", "factor", "seed"), relative),
            "threshold": (("order",), threshold),
            "result": (("order", "factor", "seed"), result),
        },
        coords={"order": list(ORDERS), "factor": factors, "seed": np.arange(settings.sweep_seeds)},
    )


def mean_square_thresholds(settings: ReproduceSettings, exact: Callable[[], xarray.Dataset]) -> np.ndarray:
    """Largest constant step (on the stage average) that is stable in mean square, unstable regime, by order.

    Quoted where the market is the default one, else computed (some ten seconds).
    """
    market = ("feasible_set", "initial_investment", "rate", "trading_hours")
    default = ReproduceSettings()
    if all(getattr(settings, name) == getattr(default, name) for name in market):
        return np.asarray([MEAN_SQUARE_THRESHOLDS[order] for order in ORDERS])
    return computed_thresholds(settings, exact())


def computed_thresholds(settings: ReproduceSettings, exact: xarray.Dataset) -> np.ndarray:
    """The thresholds by the theory's operator on sampled Jacobians at the stable policies."""
    return HORIZON * np.asarray([found.threshold_estimate for found in _stability(settings, exact, 1024)])


def floors_stage(settings: ReproduceSettings, exact: xarray.Dataset) -> xarray.Dataset:
    """Where the smaller constant step leaves E ‖M_n - M^PS‖² in the long run; inf for nowhere."""
    summed = SMALL_STEP * settings.step_size / HORIZON
    floors = [
        found.error_floor(summed) if summed < found.threshold_estimate else np.inf
        for found in _stability(settings, exact, FLOOR_SAMPLES)
    ]
    return xarray.Dataset({"floor_smaller": (("order",), floors)}, coords={"order": list(ORDERS)})


def _stability(settings: ReproduceSettings, exact: xarray.Dataset, samples: int) -> list[MeanSquareStability]:
    """Mean-square stability at the stable policies of the unstable regime."""
    problems = problems_of(settings, settings.feasible_set)[UNSTABLE : UNSTABLE + len(ORDERS)]
    stable = exact["M"].sel(regime="unstable").values[:, None]
    return [mean_square_stability(p, M, samples=samples) for p, M in zip(problems, stable, strict=True)]
