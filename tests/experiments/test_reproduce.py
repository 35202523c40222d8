"""The reproduction end to end, small: files, claims, resuming, and the rules that turn data into verdicts."""

import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray

import perfcontrol as pc
from perfcontrol import results
from perfcontrol.config import REGIMES, ReproduceSettings
from perfcontrol.experiments.batches import in_single_precision
from perfcontrol.experiments.reproduce import Outcome, reproduce
from perfcontrol.experiments.reproduce import divergence as divergence_stage
from perfcontrol.experiments.reproduce.by_stock import CEILING, costs
from perfcontrol.experiments.reproduce.cases import CASES, UNSTABLE, problems_of, silent, starts_of
from perfcontrol.experiments.reproduce.exact import exact_stage
from perfcontrol.experiments.reproduce.laboratory import constant_step, laboratory, names_of
from perfcontrol.experiments.reproduce.stages import Stages
from perfcontrol.plotting import paper_figures
from perfcontrol.reports.paper import judge, regimes, theorems
from tests.tools import normal

SETTINGS = ReproduceSettings(seeds=3, steps=100, cure_steps=200, sweep_seeds=2, sweep_steps=100)
STAGES = ("exact", "exact_simplex", "optimum", "floors", "runs", "cure", "sweep")


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    out = tmp_path_factory.mktemp("paper")
    return out, reproduce(out, SETTINGS)


def test_reproduce_writes_every_file(done: tuple[Path, Outcome]) -> None:
    out, outcome = done
    assert all(path.stat().st_size > 0 for path in outcome.files)
    expected = {"figure1_error.png", "figure2_cost.svg", "figure3_cure.png", "runs.nc", "claims.md", "claims.json"}
    assert expected <= {path.name for path in out.iterdir()}


def test_runs_hold_every_iterate_by_regime_order_seed_and_step(done: tuple[Path, Outcome]) -> None:
    runs = xarray.load_dataset(done[0] / "runs.nc", engine="h5netcdf")
    for name in ("error", "cost"):
        assert runs[name].dims == ("regime", "order", "seed", "step")
        assert runs[name].shape == (3, 3, SETTINGS.seeds, SETTINGS.steps + 1)
        assert np.isfinite(runs[name]).all()
    assert json.loads(runs.attrs["settings"])["seeds"] == SETTINGS.seeds
    assert "jax" in json.loads(runs.attrs["versions"])


def test_runs_equal_single_solves_with_the_same_key(done: tuple[Path, Outcome]) -> None:
    """The batched run is the public solver, and its recorded cost the public exact cost, in single precision."""
    runs = xarray.load_dataset(done[0] / "runs.nc", engine="h5netcdf")
    order, seed = 1, 2
    problem = pc.experiments.stock_market("descending", growth=REGIMES["stable"])
    single = in_single_precision(problem)
    key = jax.random.fold_in(pc.fast_key(SETTINGS.seed), 2_000_000 + order * SETTINGS.seeds + seed)
    M0 = starts_of(SETTINGS, problem, SETTINGS.seeds)[seed].astype(np.float32)
    solution = pc.solve(single, pc.RSGD(SETTINGS.steps, SETTINGS.step_size / 60), M0, key=key)
    stable = runs["stable_policy"].sel(regime="stable", order="descending").values
    picked = runs.sel(regime="stable", order="descending", seed=seed)
    error = np.sum((np.asarray(solution.history[:, 0]) - stable) ** 2, axis=(-2, -1))
    np.testing.assert_allclose(picked["error"], error, rtol=1e-3)
    cost = float(pc.expected_cost(problem, solution.M))
    assert float(picked["cost"][-1]) == pytest.approx(cost, rel=1e-4)


def test_stopped_runs_repeat_the_last_policy() -> None:
    problems = problems_of(SETTINGS, "rows")
    lab = laboratory(SETTINGS, problems, xarray.Dataset)
    case, steps = np.array([UNSTABLE]), 300
    solution = lab.run(case, 5, np.arange(3)[None], constant_step(10.0), steps, lambda share: None)
    assert set(names_of(solution).flat) <= {"diverged", "nonfinite"}
    assert solution.steps.max() < 100, "stopped within the first compiled call"
    policies = np.asarray(solution.history)
    assert np.all(policies[:, :, 100:] == policies[:, :, 99:100])


@pytest.mark.parametrize("feasible_set", ["rows", "simplex"])
def test_costs_stock_by_stock_are_the_exact_costs_of_the_general_engine(feasible_set: str) -> None:
    """Rows of any sums, a market of its own in every number."""
    problem = pc.experiments.stock_market("random", 0.97, 120.0, 0.2, 8.0, feasible_set=feasible_set)
    policies = 0.05 + 0.01 * np.asarray(normal(0, 1, 5, *problem.policy_shape))
    expected = [pc.expected_cost(problem, M) for M in policies[0]]
    np.testing.assert_allclose(costs(problem, policies), [expected], rtol=1e-12)


def test_costs_of_runaway_policies_are_the_ceiling() -> None:
    problem = pc.experiments.stock_market("random")
    policies = np.stack([np.full((1, 10, 10), size) for size in (0.03, 1e8, np.inf)])
    cost = costs(problem, policies.astype(np.float32))
    assert cost[0] < CEILING and np.all(cost[1:] == CEILING)


def test_smaller_step_ends_on_the_floor_that_the_theory_gives(done: tuple[Path, Outcome]) -> None:
    """Quoted: trace of the stationary covariance by the same operator on 512 sampled Jacobians."""
    found = results.load_dataset(done[0] / "floors.nc")
    floors = [float(found["floor_smaller"].sel(order=order)) for order in ("ascending", "random", "descending")]
    np.testing.assert_allclose(floors, [0.202, 0.889, 2.223], rtol=0.1)


def test_claims_are_complete_and_existence_is_settled(done: tuple[Path, Outcome]) -> None:
    claims = json.loads((done[0] / "claims.json").read_text())
    assert all({"claim", "source", "statistic", "interval", "verdict"} <= set(claim) for claim in claims)
    verdicts = {claim["verdict"] for claim in claims}
    assert verdicts <= {"holds", "holds as completed", "does not hold"}
    existence = next(claim for claim in claims if "existence" in claim["claim"])
    assert existence["verdict"] == "does not hold"
    assert existence["value"] <= 1e-11
    price = next(claim for claim in claims if "nearly optimal" in claim["claim"])
    assert price["verdict"] == "does not hold" and price["interval"][0] == price["value"] > 7
    printed = next(claim for claim in claims if "N(log ε_t" in claim["claim"])
    assert printed["verdict"] == "does not hold"


def test_without_the_simplex_its_claim_and_its_curve_are_left_out(done: tuple[Path, Outcome], tmp_path: Path) -> None:
    data = {name: results.load_dataset(done[0] / f"{name}.nc") for name in STAGES}
    exact, runs, sweep, cure = (
        data["exact"],
        data["runs"],
        data["sweep"],
        data["cure"].drop_vars("simplex").merge(data["floors"]),
    )
    claims = judge(exact, None, data["optimum"], runs, cure, sweep, SETTINGS)
    missing = {claim.claim for claim in done[1].claims} - {claim.claim for claim in claims}
    assert len(missing) == 1
    assert "simplex" in missing.pop()
    assert paper_figures.figure_cure(cure, sweep, SETTINGS, tmp_path / "cure")


@pytest.mark.slow
def test_quoted_thresholds_are_those_of_the_theory() -> None:
    problems = problems_of(SETTINGS, "rows")
    exact = exact_stage(problems, SETTINGS, silent)
    quoted = divergence_stage.mean_square_thresholds(SETTINGS, lambda: exact)
    np.testing.assert_allclose(divergence_stage.computed_thresholds(SETTINGS, exact), quoted, rtol=0.15)
    assert np.all(np.diff(quoted[[1, 2, 0]]) > 0)


def test_finished_stages_are_read_and_give_the_same_claims(done: tuple[Path, Outcome], tmp_path: Path) -> None:
    out, outcome = done
    for stage in STAGES:
        shutil.copy(out / f"{stage}.nc", tmp_path)
    again = reproduce(tmp_path, SETTINGS)
    assert all(again.seconds[stage] == 0 for stage in STAGES)
    assert again.claims == outcome.claims


def test_stage_of_other_settings_or_broken_is_not_reused(done: tuple[Path, Outcome], tmp_path: Path) -> None:
    shutil.copy(done[0] / "sweep.nc", tmp_path)
    (tmp_path / "runs.nc").write_bytes(b"cut short")
    stages = Stages(tmp_path, SETTINGS.model_copy(update={"seed": 1}), fresh=False)
    made = xarray.Dataset({"x": ((), 1.0)})
    for name in ("sweep", "runs"):
        assert float(stages.run(name, lambda: made)["x"]) == 1.0
        assert "x" in xarray.load_dataset(tmp_path / f"{name}.nc", engine="h5netcdf")


def test_reproduce_refuses_single_precision(tmp_path: Path) -> None:
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(RuntimeError, match="float64"):
            reproduce(tmp_path, SETTINGS)
    finally:
        jax.config.update("jax_enable_x64", True)


def _runs(final: float) -> xarray.Dataset:
    """Made-up runs whose error goes geometrically from 10 to `final`, every regime, order and seed alike."""
    steps = np.arange(101)
    error = 10 * (final / 10) ** (steps / 100)
    shape = (3, 3, 8, 101)
    return xarray.Dataset(
        {
            "error": (("regime", "order", "seed", "step"), np.broadcast_to(error, shape)),
            "cost": (("regime", "order", "seed", "step"), np.broadcast_to(100 + error, shape)),
            "result": (("regime", "order", "seed"), np.full(shape[:3], "success")),
            "stable_cost": (("regime", "order"), np.full((3, 3), 100.0)),
        },
        coords={**CASES, "step": steps},
    )


@pytest.mark.parametrize(("final", "decays", "diverges"), [(0.1, True, False), (100.0, False, True)])
def test_verdicts_follow_the_data(final: float, decays: bool, diverges: bool) -> None:
    runs = _runs(final)
    for regime in ("stable", "general"):
        assert (regimes.error_decays(runs, regime).verdict != "does not hold") is decays
        assert (regimes.cost_converges(runs, regime, "").verdict != "does not hold") is decays
    assert (regimes.iterates_diverge(runs).verdict != "does not hold") is diverges
    assert regimes.cost_is_larger(runs).verdict == "does not hold"
    assert regimes.order_is_negligible(runs).verdict == "holds as completed"


@pytest.mark.parametrize(("dear", "holds"), [(1.04, True), (1.2, False)])
def test_verdict_on_the_price_of_stability_follows_the_dearest_case(dear: float, holds: bool) -> None:
    cost = np.full((3, 3), 10.0)
    cost[1, 2] *= dear
    over = ("regime", "order")
    exact = xarray.Dataset({"cost": (over, cost)}, coords=CASES)
    optimum = xarray.Dataset(
        {"cost": (over, np.full((3, 3), 10.0)), "lower": (over, np.full((3, 3), 8.0))}, coords=CASES
    )
    claim = theorems.price_of_stability(exact, optimum)
    assert (claim.verdict == "holds") is holds
    assert claim.interval == pytest.approx((dear, dear / 0.8)) and "20 %" in claim.detail
    assert f"{CASES['regime'][1]}/{CASES['order'][2]}" in claim.statistic
