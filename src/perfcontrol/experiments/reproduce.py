"""The paper's numerical section, run again: every stage kept on disk as it ends, so that a killed run resumes.

Stages: `exact` (stable points without sampling), `runs` (the paper's RSGD), `cure` (what mends the divergence),
`sweep` (where divergence begins as the step grows). Then figures and the table of claims.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray
from jaxtyping import Array

from perfcontrol import results
from perfcontrol.config import REGIMES, ReproduceSettings
from perfcontrol.evaluate.exact import exact_cost, expected_cost
from perfcontrol.experiments.batches import in_single_precision, map_over_devices, pick, stack_problems
from perfcontrol.experiments.stock import HORIZON, ORDERS, stock_market
from perfcontrol.plotting import paper_figures
from perfcontrol.problem import PerformativeProblem
from perfcontrol.report import paper_claims
from perfcontrol.report.claims import Claim, as_markdown
from perfcontrol.solvers import RRM, RSGD, Result, StablePoint, solve
from perfcontrol.solvers.loop import State, run_steps

CEILING = 1e30  # costs of runaway policies are astronomical: recorded as this
COST_BLOCK = 8192  # policies whose exact cost is computed in one compiled call
CHUNK = 100  # iterations in one compiled call
STARTS = 4  # further starts of the exact solver in each case
DIMINISHING_OFFSET = 10.0  # η_n = step 10 / (n + 10)
SMALL_STEP = 0.1  # the smaller constant step, relative to the paper's
SWEEP_FACTORS = (0.25, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
# Largest constant step (on the stage average) for which the linearised iteration is stable in mean square, A = I:
# computed once by the operator of the sharp analysis, quoted here beside the simulated onset.
MEAN_SQUARE_THRESHOLDS = {"ascending": 0.0240, "random": 0.0090, "descending": 0.0046}

Progress = Callable[[str, float], None]


def _silent(stage: str, share: float) -> None:
    """No progress shown."""


class StepRule(eqx.Module):
    """η_n = constant + phi1/(n + phi2): one compiled program for constant and diminishing steps."""

    constant: Array
    phi1: Array
    phi2: Array

    def __call__(self, n: Array) -> Array:
        return self.constant + self.phi1 / (n + self.phi2)


class Outcome(NamedTuple):
    """Where the work ended: files written, claims, seconds by stage."""

    files: list[Path]
    claims: list[Claim]
    seconds: dict[str, float]


class _Runner:
    """RSGD on many (case, seed) pairs at once, in compiled calls of `CHUNK` iterations.

    In single precision: its rounding is far below the sampling noise of the runs, and they take half the time.
    """

    def __init__(self, problems: PerformativeProblem):
        self.problems = in_single_precision(problems)
        self._start = map_over_devices(self._start_one)
        self._advance = map_over_devices(self._advance_one)
        self._costs = map_over_devices(lambda case, M: exact_cost(pick(self.problems, case), M, M), batch=1)

    def _solver(self, rule: StepRule) -> RSGD:
        return RSGD(CHUNK, rule)

    def _start_one(self, case: Array, M0: Array, rule: StepRule) -> State:
        return self._solver(rule).init(pick(self.problems, case), M0)

    def _advance_one(self, case: Array, state: State, key: Array, rule: StepRule, first: Array) -> Any:
        return run_steps(self._solver(rule), pick(self.problems, case), state, key, first, CHUNK)

    def iterates(
        self, cases: Array, starts: Array, keys: Array, rule: StepRule, steps: int
    ) -> Iterator[tuple[State, Array]]:
        """States and iterates (run, CHUNK, ...) after each chunk, the last one cut to `steps`."""
        state = self._start(cases, starts, rule)
        for first in range(0, steps, CHUNK):
            offset = jnp.full(cases.shape, first)
            state, visited = self._advance(cases, state, keys, rule, offset)
            yield state, visited[:, : steps - first]

    def costs(self, cases: Array, policies: np.ndarray, taken: np.ndarray) -> np.ndarray:
        """Exact C_T(M; M) of every policy (run, step, ...), `CEILING` where it is larger or overflows.

        Policies past the step at which a run ended repeat its last one: their cost is not computed again.
        """
        runs, steps = policies.shape[:2]
        last = np.minimum(np.arange(steps), taken[:, None])
        which = np.flatnonzero(np.arange(steps) == last)
        flat, case = policies.reshape(-1, *policies.shape[2:]), np.repeat(np.asarray(cases), steps)
        values = np.empty(runs * steps)
        for first in range(0, len(which), COST_BLOCK):
            block = which[first : first + COST_BLOCK]
            filled = np.resize(block, COST_BLOCK)  # the last block repeats itself: one compiled shape for all
            values[block] = np.asarray(self._costs(case[filled], flat[filled]))[: len(block)]
        spread = np.take_along_axis(values.reshape(runs, steps), last, axis=1)
        return np.where(spread < CEILING, spread, CEILING)  # False for what is not finite


def _starts(problems: PerformativeProblem, settings: ReproduceSettings, count: int) -> Array:
    """Random portfolios, one a seed: nonnegative rows of the required sum."""
    problem = pick(problems, jnp.asarray(0))
    raw = jax.random.uniform(
        jax.random.fold_in(jax.random.key(settings.seed), 1), (count, *problem.policy_shape), problem.dtype
    )
    assert problem.feasible_set.row_total is not None
    return raw / jnp.sum(raw, axis=-1, keepdims=True) * problem.feasible_set.row_total


def _keys(settings: ReproduceSettings, stage: int, count: int) -> Array:
    return jax.random.split(jax.random.fold_in(jax.random.key(settings.seed), stage), count)


def _problems(
    settings: ReproduceSettings, feasible_set: str, volatility: str = "lognormal"
) -> list[PerformativeProblem]:
    """All cases, regime by regime, the three orders within."""
    return [
        stock_market(
            order,  # type: ignore[arg-type]
            growth=growth,
            initial_investment=settings.initial_investment,
            rate=settings.rate,
            trading_hours=settings.trading_hours,
            feasible_set=feasible_set,  # type: ignore[arg-type]
            volatility=volatility,  # type: ignore[arg-type]
        )
        for growth in REGIMES.values()
        for order in ORDERS
    ]


_CASES = {"regime": list(REGIMES), "order": list(ORDERS)}


def _by_case(values: list[Any]) -> np.ndarray:
    array = np.asarray(values)
    return array.reshape(len(REGIMES), len(ORDERS), *array.shape[1:])


# --- stages ----------------------------------------------------------------------------------------------------------


def exact_stage(settings: ReproduceSettings, feasible_set: str, progress: Progress) -> xarray.Dataset:
    """Stable points of all cases without sampling, with the evidence that they are such and the only ones."""
    problems = _problems(settings, feasible_set)
    rows: dict[str, list[Any]] = {
        name: [] for name in ("M", "residual", "unique", "rate", "agreement", "cost", "spread")
    }
    starts = _starts(stack_problems(problems), settings, STARTS)
    for index, problem in enumerate(problems):
        stable = solve(problem, StablePoint(), throw=False)
        # A start a hundred portfolios away, to see that repeated minimisation contracts, and how fast.
        away = problem.feasible_set.project(100 * starts[0])
        repeated = solve(problem, RRM(), away, throw=False)
        others = [
            solve(problem, StablePoint(), problem.feasible_set.project(10 * start), throw=False).M for start in starts
        ]
        scale = jnp.linalg.norm(stable.M)
        rows["M"].append(np.asarray(stable.M[0]))
        rows["residual"].append(float(stable.stats["residual"]))
        rows["unique"].append(bool(stable.stats["unique"]))
        rate = float(repeated.stats["rate"])
        rows["rate"].append(rate if np.isfinite(rate) else 0.0)  # converged at once: no ratio to take
        rows["agreement"].append(float(jnp.linalg.norm(repeated.M - stable.M) / scale))
        rows["spread"].append(float(max(jnp.linalg.norm(other - stable.M) for other in others) / scale))
        rows["cost"].append(float(expected_cost(problem, stable.M)))
        progress("exact stable points", (index + 1) / len(problems))
    cases = ("regime", "order")
    return xarray.Dataset(
        {
            name: ((*cases, "row", "column") if name == "M" else cases, _by_case(values))
            for name, values in rows.items()
        },
        coords=_CASES,
    )


def run_stage(
    runner: _Runner, exact: xarray.Dataset, settings: ReproduceSettings, progress: Progress
) -> xarray.Dataset:
    """The paper's RSGD: error and exact cost of every iterate."""
    seeds, steps = settings.seeds, settings.steps
    shape = (len(REGIMES), len(ORDERS), seeds)
    error, cost = np.empty((*shape, steps + 1)), np.empty((*shape, steps + 1))
    result, taken = np.empty(shape, dtype=object), np.empty(shape, dtype=int)
    starts = jnp.tile(_starts(runner.problems, settings, seeds), (len(ORDERS), 1, 1, 1))
    keys = _keys(settings, 2, len(ORDERS) * seeds)
    rule = _constant(settings.step_size, keys.shape[0])
    for r, regime in enumerate(REGIMES):
        cases = jnp.repeat(jnp.arange(len(ORDERS)) + r * len(ORDERS), seeds)
        target = exact["M"].sel(regime=regime).values[:, None, None]
        blocks = [np.asarray(starts[:, None])]
        final = None
        for state, visited in runner.iterates(cases, starts, keys, rule, steps):
            final = state
            blocks.append(np.asarray(visited))
            progress("RSGD runs", (r + 0.5 * (len(blocks) - 1) * CHUNK / steps) / len(REGIMES))
        assert final is not None
        result[r], taken[r] = _named(final, shape[1:])
        policies = np.concatenate(blocks, axis=1)
        error[r] = np.sum((policies.reshape(*shape[1:], steps + 1, *policies.shape[-2:]) - target) ** 2, axis=(-2, -1))
        cost[r] = runner.costs(cases, policies, taken[r].reshape(-1)).reshape(cost[r].shape)
        progress("RSGD runs", (r + 1) / len(REGIMES))
    dims = ("regime", "order", "seed")
    data = {
        "error": ((*dims, "step"), error, {"long_name": "squared Frobenius distance to the stable policy"}),
        "cost": (
            (*dims, "step"),
            cost,
            {"long_name": f"expected total cost C_T(M_n; M_n), exact to single precision, at most {CEILING:g}"},
        ),
        "result": (dims, result.astype(str), {"long_name": "how the run ended"}),
        "steps_taken": (dims, taken, {"long_name": "iterations until the run ended"}),
        "stable_policy": (("regime", "order", "row", "column"), exact["M"].values),
        "stable_cost": (("regime", "order"), exact["cost"].values),
    }
    return xarray.Dataset(data, coords={**_CASES, "seed": np.arange(seeds), "step": np.arange(steps + 1)})


def cure_stage(
    runner: _Runner,
    exact: xarray.Dataset,
    bounded: _Runner,
    exact_bounded: xarray.Dataset,
    settings: ReproduceSettings,
    progress: Progress,
) -> xarray.Dataset:
    """The unstable regime again: with a diminishing step, with a smaller one, and on the bounded simplex."""
    seeds = settings.cure_seeds
    r = list(REGIMES).index("unstable")
    cases = jnp.repeat(jnp.arange(len(ORDERS)) + r * len(ORDERS), seeds)
    starts = jnp.tile(_starts(runner.problems, settings, seeds), (len(ORDERS), 1, 1, 1))
    keys = _keys(settings, 3, cases.shape[0])
    step = settings.step_size
    plans = {
        "diminishing": (runner, exact, _diminishing(step, cases.shape[0]), settings.cure_steps),
        "smaller": (runner, exact, _constant(SMALL_STEP * step, cases.shape[0]), settings.steps),
        "simplex": (bounded, exact_bounded, _constant(step, cases.shape[0]), settings.steps),
    }
    data: dict[str, Any] = {}
    total = sum(steps for *_, steps in plans.values())
    done = 0
    for name, (engine, stable, rule, steps) in plans.items():
        target = stable["M"].sel(regime="unstable").values[:, None, None]
        errors = []
        for _, visited in engine.iterates(cases, starts, keys, rule, steps):
            part = np.asarray(visited).reshape(len(ORDERS), seeds, visited.shape[1], *visited.shape[-2:])
            errors.append(np.sum((part - target) ** 2, axis=(-2, -1)))
            done += visited.shape[1]
            progress("what cures divergence", done / total)
        data[name] = (("order", "seed", f"step_{name}"), np.concatenate(errors, axis=-1))
        data[f"step_{name}"] = ((f"step_{name}",), np.arange(1, steps + 1))
    return xarray.Dataset(data, coords={"order": list(ORDERS), "seed": np.arange(seeds)})


def sweep_stage(
    runner: _Runner, exact: xarray.Dataset, settings: ReproduceSettings, progress: Progress
) -> xarray.Dataset:
    """Constant steps around the mean-square thresholds of the unstable regime: which runs do not come closer."""
    seeds, factors = settings.sweep_seeds, np.asarray(SWEEP_FACTORS)
    r = list(REGIMES).index("unstable")
    grid = (len(ORDERS), len(factors), seeds)
    order, factor, seed = np.indices(grid).reshape(3, -1)
    threshold = np.asarray([MEAN_SQUARE_THRESHOLDS[name] for name in ORDERS])
    step = threshold[order] * factors[factor]
    starts = _starts(runner.problems, settings, seeds)[seed]
    rule = _constant(jnp.asarray(step), len(step))
    cases = jnp.asarray(order + r * len(ORDERS))
    keys = _keys(settings, 4, len(step))
    final, done = None, 0
    for state, visited in runner.iterates(cases, starts, keys, rule, settings.sweep_steps):
        final, done = (state, visited), done + CHUNK
        progress("where divergence begins", done / settings.sweep_steps)
    assert final is not None
    state, last = final
    target = exact["M"].sel(regime="unstable").values[order]
    error = np.sum((np.asarray(last)[:, -1, 0] - target) ** 2, axis=(-2, -1)).reshape(grid)
    start = np.sum((np.asarray(starts)[:, 0] - target) ** 2, axis=(-2, -1)).reshape(grid)
    return xarray.Dataset(
        {
            "relative_error": (("order", "factor", "seed"), error / start),
            "threshold": (("order",), threshold),
            "result": (("order", "factor", "seed"), _named(state, grid)[0].astype(str)),
        },
        coords={"order": list(ORDERS), "factor": factors, "seed": np.arange(seeds)},
    )


def as_printed_stage(settings: ReproduceSettings) -> dict[str, float]:
    """The volatility as printed: how much of anything still depends on the policy."""
    problem = _problems(settings, "rows", "as_printed")[0]
    perturbation = problem.perturbation
    variance = np.asarray(perturbation.variance)  # type: ignore[attr-defined]
    first = _starts(stack_problems([problem]), settings, 2)
    far = [solve(problem, RRM(), start, throw=False) for start in first]
    return {
        "largest_variance": float(np.max(np.abs(variance))),
        "steps_of_rrm": float(max(int(solution.steps) for solution in far)),
        "response_difference": float(jnp.max(jnp.abs(far[0].history[1] - far[1].history[1]))),
    }


def _constant(step: Any, count: int) -> StepRule:
    size = jnp.broadcast_to(jnp.asarray(step, dtype=jnp.float32) / HORIZON, (count,))
    return StepRule(size, jnp.zeros_like(size), jnp.ones_like(size))


def _diminishing(step: float, count: int) -> StepRule:
    offset = jnp.full(count, DIMINISHING_OFFSET, dtype=jnp.float32)
    return StepRule(jnp.zeros_like(offset), step / HORIZON * offset, offset)


def _named(state: State, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Result names and step counts of a batch of states."""
    names = ("running", "diverged", "nonfinite")
    codes = {name: np.asarray(getattr(Result, name)._value) for name in names}
    values = np.asarray(state.result._value).reshape(shape)
    named = np.full(shape, "success", dtype=object)
    for name in names[1:]:
        named[values == codes[name]] = name
    return named, np.asarray(state.steps).reshape(shape)


# --- the whole -------------------------------------------------------------------------------------------------------


class _Stages:
    """Stages kept on disk under the fingerprint of what they depend on; a finished one is read, not run again."""

    def __init__(self, folder: Path, settings: ReproduceSettings, fresh: bool):
        self.folder, self.settings, self.fresh = folder, settings, fresh
        text = json.dumps([settings.model_dump(), results.versions()], sort_keys=True)
        self.fingerprint = hashlib.sha256(text.encode()).hexdigest()[:16]
        self.seconds: dict[str, float] = {}

    def run(self, name: str, compute: Callable[[], xarray.Dataset]) -> xarray.Dataset:
        path = self.folder / f"{name}.nc"
        if not self.fresh and path.exists():
            try:
                dataset = results.load_dataset(path)
            except (OSError, ValueError, KeyError):  # not ours, or cut short by an older version: run again
                dataset = None
            if dataset is not None and dataset.attrs.get("fingerprint") == self.fingerprint:
                self.seconds[name] = 0.0
                return dataset
        began = time.monotonic()
        dataset = compute()
        attributes = {"settings": self.settings.model_dump(), "fingerprint": self.fingerprint}
        results.save_dataset(dataset, path, attributes)
        self.seconds[name] = time.monotonic() - began
        return dataset


def reproduce(out: Path, settings: ReproduceSettings, progress: Progress | None = None, fresh: bool = False) -> Outcome:
    """Run every stage, draw the figures, judge the claims, write all files under `out`.

    Args:
        out: folder, made if missing.
        settings: what to run.
        progress: called with (stage, share done).
        fresh: run stages again even where their results are there.

    Returns:
        Files written, claims, and seconds spent in each stage (0 for stages that were read).
    """
    if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise RuntimeError('The reproduction needs float64: call jax.config.update("jax_enable_x64", True) first.')
    results.check_writable(out)
    progress = progress or _silent
    stages = _Stages(out, settings, fresh)
    runner = _Runner(stack_problems(_problems(settings, settings.feasible_set)))
    bounded = _Runner(stack_problems(_problems(settings, "simplex")))
    with ThreadPoolExecutor() as pool:  # side by side: both spend their time in one-core compilation
        pending = pool.submit(stages.run, "exact_simplex", lambda: exact_stage(settings, "simplex", _silent))
        exact = stages.run("exact", lambda: exact_stage(settings, settings.feasible_set, progress))
        exact_bounded = pending.result()
    runs = stages.run("runs", lambda: run_stage(runner, exact, settings, progress))
    cure = stages.run("cure", lambda: cure_stage(runner, exact, bounded, exact_bounded, settings, progress))
    sweep = stages.run("sweep", lambda: sweep_stage(runner, exact, settings, progress))
    began = time.monotonic()
    claims = paper_claims.judge(exact, exact_bounded, runs, cure, sweep, as_printed_stage(settings), settings)
    results.save_json([claim.as_dict() for claim in claims], out / "claims.json")
    results.save_text(as_markdown(claims, settings.model_dump()), out / "claims.md")
    stages.seconds["claims"] = time.monotonic() - began
    began = time.monotonic()
    files = paper_figures.draw_all(out, exact, runs, cure, sweep, settings)
    stages.seconds["figures"] = time.monotonic() - began
    names = ("exact.nc", "exact_simplex.nc", "runs.nc", "cure.nc", "sweep.nc", "claims.json", "claims.md")
    return Outcome([*(out / name for name in names), *files], claims, stages.seconds)
