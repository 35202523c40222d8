"""The paper's runs: what all stages with runs share, and RSGD in every case."""

from typing import Any, NamedTuple

import jax
import numpy as np
import xarray

from perfcontrol.config import REGIMES, ReproduceSettings
from perfcontrol.experiments.batches import CEILING, Ended, Runner, Runs, StepRule, stack_problems
from perfcontrol.experiments.reproduce.cases import CASES, Progress, starts_of
from perfcontrol.experiments.stock import HORIZON, ORDERS
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_keys import fast_key

DIMINISHING_OFFSET = 10.0  # η_n = step 10 / (n + 10)


class Laboratory(NamedTuple):
    """What the stages with runs share: the compiled runner of a feasible set, its stable policies, the starts."""

    runner: Runner
    exact: xarray.Dataset
    starts: np.ndarray

    def runs(self, stage: int, case: np.ndarray, stream: np.ndarray, seed: np.ndarray, step: StepRule) -> Runs:
        """One run for each entry of the index arrays; `stage` keeps the random numbers of stages apart."""
        rule = jax.tree.map(lambda value: np.broadcast_to(np.float32(value), case.shape), step)
        return Runs(case, stage * 1_000_000 + stream, self.starts[seed], rule)

    def errors(self, runs: Runs, ended: Ended) -> np.ndarray:
        """‖M_n - M^PS‖²_F, (rows, steps+1)."""
        stable = self.exact["M"].values.reshape(-1, *ended.policies.shape[-2:])[runs.case[ended.rows]]
        return np.sum((ended.policies[:, :, 0] - stable[:, None]) ** 2, axis=(-2, -1))


def laboratory(settings: ReproduceSettings, problems: list[PerformativeProblem], exact: xarray.Dataset) -> Laboratory:
    """The laboratory of one feasible set."""
    seeds = max(settings.seeds, settings.cure_seeds, settings.sweep_seeds)
    starts = starts_of(settings, problems[0], seeds).astype(np.float32)
    return Laboratory(Runner(stack_problems(problems), fast_key(settings.seed)), exact, starts)


def constant_step(step: Any) -> StepRule:
    """A step on the stage average, the same in every iteration."""
    return StepRule(step / HORIZON, 0.0, 1.0)


def diminishing_step(step: float) -> StepRule:
    """A step on the stage average that falls like 1/n."""
    return StepRule(0.0, step / HORIZON * DIMINISHING_OFFSET, DIMINISHING_OFFSET)


def run_stage(lab: Laboratory, settings: ReproduceSettings, progress: Progress) -> xarray.Dataset:
    """The paper's RSGD: error and exact cost of every iterate."""
    seeds, length = settings.seeds, settings.steps + 1
    shape = (len(REGIMES), len(ORDERS), seeds)
    regime, order, seed = np.indices(shape).reshape(3, -1)
    # Regimes share their random numbers: what differs between the panels is the regime.
    case, stream = regime * len(ORDERS) + order, order * seeds + seed
    runs = lab.runs(2, case, stream, seed, constant_step(settings.step_size))
    error, cost = np.empty((2, case.size, length))
    result, taken = np.empty(case.size, dtype="<U9"), np.empty(case.size, dtype=int)
    for ended in lab.runner.run(runs, settings.steps, lambda share: progress("RSGD runs", share)):
        error[ended.rows] = lab.errors(runs, ended)
        cost[ended.rows] = lab.runner.costs(runs, ended)
        result[ended.rows], taken[ended.rows] = ended.result, ended.steps_taken
    dims = ("regime", "order", "seed")
    per_step = ((*dims, "step"), (*shape, length))
    data = {
        "error": (per_step[0], error.reshape(per_step[1]), {"long_name": "squared distance to the stable policy"}),
        "cost": (
            per_step[0],
            cost.reshape(per_step[1]),
            {"long_name": f"expected total cost C_T(M_n; M_n), exact to single precision, at most {CEILING:g}"},
        ),
        "result": (dims, result.reshape(shape), {"long_name": "how the run ended"}),
        "steps_taken": (dims, taken.reshape(shape), {"long_name": "iterations until the run ended"}),
        "stable_policy": (("regime", "order", "row", "column"), lab.exact["M"].values),
        "stable_cost": (("regime", "order"), lab.exact["cost"].values),
    }
    return xarray.Dataset(data, coords={**CASES, "seed": np.arange(seeds), "step": np.arange(length)})
