"""The paper's runs: what all stages with runs share, and RSGD in every case."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray
from jaxtyping import Array

from perfcontrol.config import REGIMES, ReproduceSettings
from perfcontrol.experiments.batches import StepRule, in_single_precision
from perfcontrol.experiments.reproduce.by_stock import CEILING, costs
from perfcontrol.experiments.reproduce.cases import CASES, Progress, starts_of
from perfcontrol.experiments.reproduce.path_gradient import StockByStock
from perfcontrol.experiments.stock import HORIZON, ORDERS
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_keys import fast_key
from perfcontrol.solvers import RSGD, Solution, solve_many
from perfcontrol.solvers.result import MEMBERS, where
from perfcontrol.solvers.runs import identity

DIMINISHING_OFFSET = 10.0  # η_n = step 10 / (n + 10)


class Laboratory(NamedTuple):
    """What the stages with runs share: the problems of a feasible set, their stable policies, starts, random numbers.

    Runs are in single precision: its rounding is far below their sampling noise, and they take half the time.
    """

    problems: PerformativeProblem  # stacked, on the host
    exact: Callable[[], xarray.Dataset]  # asked for once runs have ended: both are worked on at the same time
    starts: np.ndarray  # (seeds, 1, stocks, stocks)
    root: Array

    def run(
        self, cases: Any, stage: int, stream: np.ndarray, rules: Any, steps: int, show: Callable[[float], None]
    ) -> Solution:
        """RSGD in some cases, or one; `stream` has the axes of the answer, the last one the seeds, and with `stage`
        says which random numbers each run uses.
        """
        keys = _keys(self.root, stage * 1_000_000 + stream)
        several = isinstance(rules, list)
        solvers = [RSGD(1, rule, gradient=StockByStock()) for rule in (rules if several else [rules])]
        starts = self.starts[: stream.shape[-1]].reshape(*(1,) * (stream.ndim - 1), -1, *self.starts.shape[1:])
        return solve_many(
            jax.device_put(jax.tree.map(lambda leaf: leaf[cases], self.problems)),
            solvers if several else solvers[0],
            starts,
            keys=keys,
            max_steps=steps,  # so that stages of other lengths need not be compiled anew
            record=identity,
            progress=lambda done, total: show(done / total),
        )

    def errors(self, cases: Any, solution: Solution) -> np.ndarray:
        """‖M_n - M^PS‖²_F, with the axes of the runs and one of steps."""
        policies = np.asarray(solution.history)[..., 0, :, :]
        stable = self.exact()["M"].values.reshape(-1, 1, 1, *policies.shape[-2:])[cases]
        away = policies - stable
        return np.einsum("...ij,...ij->...", away, away)


def laboratory(
    settings: ReproduceSettings, problems: list[PerformativeProblem], exact: Callable[[], xarray.Dataset]
) -> Laboratory:
    """The laboratory of one feasible set."""
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *map(in_single_precision, problems))
    seeds = max(settings.seeds, settings.cure_seeds, settings.sweep_seeds)
    starts = starts_of(settings, problems[0], seeds).astype(np.float32)
    return Laboratory(stacked, exact, starts, fast_key(settings.seed))


@jax.jit
def _keys(root: Array, numbers: Array) -> Array:
    """The key of each number."""
    fold = jax.vmap(lambda number: jax.random.fold_in(root, number))
    return fold(numbers.reshape(-1)).reshape(numbers.shape)


def constant_step(step: Any) -> StepRule:
    """A step on the stage average, the same in every iteration."""
    return StepRule(np.float32(step / HORIZON), np.float32(0), np.float32(1))


def diminishing_step(step: float) -> StepRule:
    """A step on the stage average that falls like 1/n."""
    rising = np.float32(step / HORIZON * DIMINISHING_OFFSET)
    return StepRule(np.float32(0), rising, np.float32(DIMINISHING_OFFSET))


def names_of(solution: Solution) -> np.ndarray:
    """How each run ended, in a word."""
    names = np.empty(solution.steps.shape, dtype="<U9")
    for name, member in MEMBERS.items():
        names[where(solution.result, member)] = name
    return names


def run_stage(
    lab: Laboratory, problems: list[PerformativeProblem], settings: ReproduceSettings, progress: Progress
) -> xarray.Dataset:
    """The paper's RSGD: error and exact cost of every iterate."""
    seeds, length = settings.seeds, settings.steps + 1
    shape = (len(REGIMES), len(ORDERS), seeds)
    cases = np.arange(len(REGIMES) * len(ORDERS))
    # Regimes share their random numbers: what differs between the panels is the regime.
    stream = cases[:, None] % len(ORDERS) * seeds + np.arange(seeds)
    rule = constant_step(settings.step_size)
    solution = lab.run(cases, 2, stream, rule, settings.steps, lambda share: progress("RSGD runs", share))
    taken = np.asarray(solution.steps)
    error, history = lab.errors(cases, solution), np.asarray(solution.history)
    with ThreadPoolExecutor() as pool:
        cost = np.stack(list(pool.map(costs, problems, history)))
    dims = ("regime", "order", "seed")
    per_step = ((*dims, "step"), (*shape, length))
    data = {
        "error": (per_step[0], error.reshape(per_step[1]), {"long_name": "squared distance to the stable policy"}),
        "cost": (
            per_step[0],
            cost.reshape(per_step[1]),
            {"long_name": f"expected total cost C_T(M_n; M_n), exact to single precision, at most {CEILING:g}"},
        ),
        "result": (dims, names_of(solution).reshape(shape), {"long_name": "how the run ended"}),
        "steps_taken": (dims, taken.reshape(shape), {"long_name": "iterations until the run ended"}),
        "stable_policy": (("regime", "order", "row", "column"), lab.exact()["M"].values),
        "stable_cost": (("regime", "order"), lab.exact()["cost"].values),
    }
    return xarray.Dataset(data, coords={**CASES, "seed": np.arange(seeds), "step": np.arange(length)})
