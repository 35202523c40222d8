"""The paper's numerical section, run again: every stage kept on disk as it ends, so that a killed run resumes.

Stages: `exact` (stable points without sampling), `runs` (the paper's RSGD), `cure` (what mends the divergence),
`sweep` (where divergence begins as the step grows). Then figures and the table of claims.
"""

import hashlib
import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import xarray

from perfcontrol import results
from perfcontrol.config import REGIMES, ReproduceSettings
from perfcontrol.evaluate.exact import expected_cost
from perfcontrol.experiments.batches import CEILING, Ended, Runner, Runs, StepRule, stack_problems
from perfcontrol.experiments.stock import HORIZON, ORDERS, STOCKS, stock_market
from perfcontrol.plotting import paper_figures
from perfcontrol.problem import PerformativeProblem
from perfcontrol.report import paper_claims
from perfcontrol.report.claims import Claim, as_markdown
from perfcontrol.solvers import RRM, StablePoint, solve
from perfcontrol.theory import mean_square_stability

UNSTABLE = list(REGIMES).index("unstable") * len(ORDERS)  # its first case
STAGES = ("exact", "exact_simplex", "runs", "cure", "sweep")
STARTS = 4  # further starts of the exact solver in each case
DIMINISHING_OFFSET = 10.0  # η_n = step 10 / (n + 10)
SMALL_STEP = 0.1  # the smaller constant step, relative to the paper's
SWEEP_FACTORS = (0.25, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)
# Largest constant step (on the stage average) that is stable in mean square, default market, unstable regime: by the
# operator of `computed_thresholds` on 16,384 sampled Jacobians, within one per cent.
MEAN_SQUARE_THRESHOLDS = {"ascending": 0.0236, "random": 0.00898, "descending": 0.00461}

Progress = Callable[[str, float], None]


def _silent(stage: str, share: float) -> None:
    """No progress shown."""


class Outcome(NamedTuple):
    """Where the work ended: files written, claims, seconds by stage."""

    files: list[Path]
    claims: list[Claim]
    seconds: dict[str, float]


def _starts(settings: ReproduceSettings, problem: PerformativeProblem, count: int) -> np.ndarray:
    """Random portfolios (count, 1, L, L), one a seed: nonnegative rows of the required sum."""
    total = problem.feasible_set.row_total
    assert total is not None
    raw = np.random.default_rng([settings.seed, 1]).uniform(size=(count, 1, STOCKS, STOCKS))
    return raw / raw.sum(axis=-1, keepdims=True) * float(total)


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


def _by_case(rows: dict[str, list[Any]]) -> xarray.Dataset:
    """One value a case, matrices included, by regime and order."""
    cases, arrays = ("regime", "order"), {name: np.asarray(values) for name, values in rows.items()}
    data = {
        name: (
            (*cases, "row", "column")[: array.ndim + 1],
            array.reshape(len(REGIMES), len(ORDERS), *array.shape[1:]),
        )
        for name, array in arrays.items()
    }
    return xarray.Dataset(data, coords=_CASES)


# --- stages ----------------------------------------------------------------------------------------------------------


def exact_stage(problems: list[PerformativeProblem], settings: ReproduceSettings, progress: Progress) -> xarray.Dataset:
    """Stable points of all cases without sampling, with the evidence that they are such and the only ones."""
    rows: dict[str, list[Any]] = {name: [] for name in ("M", "residual", "unique", "spread")}
    for index, problem in enumerate(problems):
        stable = solve(problem, StablePoint(), throw=False)
        M = np.asarray(stable.M)
        others = [
            np.asarray(solve(problem, StablePoint(), start, throw=False).M)
            for start in _starts(settings, problem, STARTS)
        ]
        rows["M"].append(M[0])
        rows["residual"].append(float(stable.stats["residual"]))
        rows["unique"].append(bool(stable.stats["unique"]))
        rows["spread"].append(max(float(np.linalg.norm(other - M)) for other in others) / float(np.linalg.norm(M)))
        progress("exact stable points", (index + 1) / len(problems))
    return _by_case(rows)


def repeated_minimisation(
    problems: list[PerformativeProblem], exact: xarray.Dataset, settings: ReproduceSettings
) -> xarray.Dataset:
    """`exact` with repeated minimisation beside it: where it ends from afar, how fast it contracts; exact costs.

    And with the volatility as printed: how much of anything still depends on the policy.
    """
    rows: dict[str, list[Any]] = {name: [] for name in ("rate", "agreement", "cost")}
    starts = _starts(settings, problems[0], 2)
    project = jax.jit(lambda problem, M: problem.feasible_set.project(M))
    for problem, M in zip(problems, exact["M"].values.reshape(len(problems), 1, STOCKS, STOCKS), strict=True):
        # A start a hundred portfolios away, to see that it contracts.
        repeated = solve(problem, RRM(), project(problem, 100 * starts[0]), throw=False)
        rate = float(repeated.stats["rate"])
        rows["rate"].append(rate if np.isfinite(rate) else 0.0)  # converged at once: no ratio to take
        rows["agreement"].append(float(np.linalg.norm(np.asarray(repeated.M) - M) / np.linalg.norm(M)))
        rows["cost"].append(float(expected_cost(problem, M)))
    perturbation: Any = _problems(settings, settings.feasible_set, "as_printed")[0].perturbation
    # Exact evaluation sees a perturbation's moments alone: those as printed, in the program that is compiled already.
    printed = eqx.tree_at(
        lambda p: (p.perturbation.first_moment, p.perturbation.variance),
        problems[0],
        (perturbation.first_moment, perturbation.variance),
    )
    ends = [solve(printed, RRM(), start, throw=False) for start in starts]
    responses = [np.asarray(end.history[1]) for end in ends]
    return exact.merge(_by_case(rows)).assign(
        printed_variance=float(np.max(np.abs(np.asarray(perturbation.variance)))),
        printed_steps=max(int(end.steps) for end in ends),
        printed_difference=float(np.max(np.abs(responses[0] - responses[1]))),
    )


class _Laboratory(NamedTuple):
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


def _laboratory(settings: ReproduceSettings, problems: list[PerformativeProblem], exact: xarray.Dataset) -> _Laboratory:
    seeds = max(settings.seeds, settings.cure_seeds, settings.sweep_seeds)
    starts = _starts(settings, problems[0], seeds).astype(np.float32)
    return _Laboratory(Runner(stack_problems(problems), jax.random.key(settings.seed)), exact, starts)


def _constant(step: Any) -> StepRule:
    return StepRule(step / HORIZON, 0.0, 1.0)


def _diminishing(step: float) -> StepRule:
    return StepRule(0.0, step / HORIZON * DIMINISHING_OFFSET, DIMINISHING_OFFSET)


def run_stage(lab: _Laboratory, settings: ReproduceSettings, progress: Progress) -> xarray.Dataset:
    """The paper's RSGD: error and exact cost of every iterate."""
    seeds, length = settings.seeds, settings.steps + 1
    shape = (len(REGIMES), len(ORDERS), seeds)
    regime, order, seed = np.indices(shape).reshape(3, -1)
    # Regimes share their random numbers: what differs between the panels is the regime.
    case, stream = regime * len(ORDERS) + order, order * seeds + seed
    runs = lab.runs(2, case, stream, seed, _constant(settings.step_size))
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
    return xarray.Dataset(data, coords={**_CASES, "seed": np.arange(seeds), "step": np.arange(length)})


def cure_stage(
    lab: _Laboratory, bounded: _Laboratory | None, settings: ReproduceSettings, progress: Progress
) -> xarray.Dataset:
    """The unstable regime again: with a diminishing step, with a smaller one, and on the bounded simplex."""
    shape = (len(ORDERS), settings.cure_seeds)
    order, seed = np.indices(shape).reshape(2, -1)
    step = settings.step_size
    plans = {
        "diminishing": (lab, _diminishing(step), settings.cure_steps),
        "smaller": (lab, _constant(SMALL_STEP * step), settings.steps),
    }
    if bounded is not None:
        plans["simplex"] = (bounded, _constant(step), settings.steps)
    data: dict[str, Any] = {}
    total, before = sum(steps for *_, steps in plans.values()), 0
    for name, (place, rule, steps) in plans.items():

        def show(share: float, before: int = before, steps: int = steps) -> None:
            progress("what cures divergence", (before + share * steps) / total)

        runs = place.runs(3, UNSTABLE + order, np.arange(order.size), seed, rule)
        errors = np.empty((order.size, steps + 1))
        for ended in place.runner.run(runs, steps, show):
            errors[ended.rows] = place.errors(runs, ended)
        data[name] = (("order", "seed", f"step_{name}"), errors[:, 1:].reshape(*shape, steps))
        data[f"step_{name}"] = ((f"step_{name}",), np.arange(1, steps + 1))
        before += steps
    return xarray.Dataset(data, coords={"order": list(ORDERS), "seed": np.arange(settings.cure_seeds)})


def sweep_stage(lab: _Laboratory, settings: ReproduceSettings, progress: Progress) -> xarray.Dataset:
    """Constant steps around the mean-square thresholds of the unstable regime: which runs do not come closer."""
    factors = np.asarray(SWEEP_FACTORS)
    grid = (len(ORDERS), len(factors), settings.sweep_seeds)
    order, factor, seed = np.indices(grid).reshape(3, -1)
    threshold = mean_square_thresholds(settings, lab.exact)
    rule = _constant(threshold[order] * factors[factor])
    runs = lab.runs(4, UNSTABLE + order, np.arange(order.size), seed, rule)
    relative, result = np.empty(order.size), np.empty(order.size, dtype="<U9")
    for ended in lab.runner.run(runs, settings.sweep_steps, lambda share: progress("where divergence begins", share)):
        error = lab.errors(runs, ended)
        relative[ended.rows], result[ended.rows] = error[:, -1] / error[:, 0], ended.result
    return xarray.Dataset(
        {
            "relative_error": (("order", "factor", "seed"), relative.reshape(grid)),
            "threshold": (("order",), threshold),
            "result": (("order", "factor", "seed"), result.reshape(grid)),
        },
        coords={"order": list(ORDERS), "factor": factors, "seed": np.arange(settings.sweep_seeds)},
    )


def mean_square_thresholds(settings: ReproduceSettings, exact: xarray.Dataset) -> np.ndarray:
    """Largest constant step (on the stage average) that is stable in mean square, unstable regime, by order.

    Quoted where the market is the default one, else computed (some ten seconds).
    """
    market = ("feasible_set", "initial_investment", "rate", "trading_hours")
    default = ReproduceSettings()
    if all(getattr(settings, name) == getattr(default, name) for name in market):
        return np.asarray([MEAN_SQUARE_THRESHOLDS[order] for order in ORDERS])
    return computed_thresholds(settings, exact)


def computed_thresholds(settings: ReproduceSettings, exact: xarray.Dataset) -> np.ndarray:
    """The thresholds by the theory's operator on sampled Jacobians at the stable policies."""
    problems = _problems(settings, settings.feasible_set)[UNSTABLE : UNSTABLE + len(ORDERS)]
    stable = exact["M"].sel(regime="unstable").values[:, None]
    steps = [mean_square_stability(p, M).threshold_estimate for p, M in zip(problems, stable, strict=True)]
    return HORIZON * np.asarray(steps)


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
    problems, bounded_problems = _problems(settings, settings.feasible_set), _problems(settings, "simplex")

    def exact_and_repeated() -> xarray.Dataset:
        return repeated_minimisation(problems, exact_stage(problems, settings, progress), settings)

    with ThreadPoolExecutor() as pool:  # side by side: both spend their time in one-core compilation
        waiting = [
            pool.submit(stages.run, "exact_simplex", lambda: exact_stage(bounded_problems, settings, _silent))
            for _ in range(settings.simplex)
        ]
        exact = stages.run("exact", exact_and_repeated)
        exact_bounded = waiting[0].result() if waiting else None
    lab = _laboratory(settings, problems, exact)
    bounded = None if exact_bounded is None else _laboratory(settings, bounded_problems, exact_bounded)
    runs = stages.run("runs", lambda: run_stage(lab, settings, progress))
    cure = stages.run("cure", lambda: cure_stage(lab, bounded, settings, progress))
    sweep = stages.run("sweep", lambda: sweep_stage(lab, settings, progress))
    began = time.monotonic()
    claims = paper_claims.judge(exact, exact_bounded, runs, cure, sweep, settings)
    results.save_json([claim.as_dict() for claim in claims], out / "claims.json")
    results.save_text(as_markdown(claims, settings.model_dump()), out / "claims.md")
    stages.seconds["claims"] = time.monotonic() - began
    began = time.monotonic()
    files = paper_figures.draw_all(out, exact, runs, cure, sweep, settings)
    stages.seconds["figures"] = time.monotonic() - began
    data = [out / f"{stage}.nc" for stage in STAGES if stage in stages.seconds]
    return Outcome([*data, out / "claims.json", out / "claims.md", *files], claims, stages.seconds)
