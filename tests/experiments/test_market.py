"""The market of one's own prices: its laws, its allocations, and what they cost in recorded days."""

import json

import cvxpy
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from typer.testing import CliRunner

import perfcontrol as pc
from perfcontrol.cli.app import app
from perfcontrol.experiments.prices.allocations import ALLOCATIONS, allocations, minimum_variance
from perfcontrol.experiments.prices.capital import capital_sweep
from perfcontrol.experiments.prices.market import recorded_days
from perfcontrol.experiments.prices.windows import realised_cost, rolling_windows
from tests.experiments.price_files import lines, prices
from tests.oracles.moments import expected_cost_moments
from tests.tools import assert_close, assert_mean_is, assert_refused, normal, random_psd

EXPOSURE = 6.5 / 17.5
HORIZON = 8


def test_laws_are_those_of_the_recorded_days():
    values = prices(1)
    problem = pc.experiments.market(values, 20, capital=70, rate=0.1, trading_hours=8, feasible_set="simplex")
    ratios = values[1:] / values[:-1] / np.exp(0.1 / 252)
    growth = problem.perturbation.growth
    assert_close(growth.log_mean, np.log(ratios).mean(axis=0), 1e-10)
    assert_close(growth.log_covariance, np.cov(np.log(ratios).T), 1e-10)
    risk = 100 * 16 / 24 * (ratios - 1)  # of the 16 hours in which the market is closed
    assert_close(problem.noise.mean, np.concatenate([np.zeros(3), risk.mean(axis=0)]), 1e-10)
    assert_close(problem.noise.covariance, np.kron(np.ones((2, 2)), np.cov(risk.T, ddof=0)), 1e-10)
    assert_close(problem.initial_state.mean, np.repeat([0.0, 70.0], 3))
    assert (problem.horizon, problem.policy_shape) == (20, (1, 3, 3))
    assert isinstance(problem.feasible_set, pc.RowSimplex)
    assert float(problem.feasible_set.total) == pytest.approx(8 / 16)


def test_laws_of_a_known_market_are_recovered_within_five_standard_errors():
    drift, spread = np.array([1e-3, -5e-4, 0.0]), 1e-4 * np.asarray(random_psd(3, 3), dtype=float)
    rng = np.random.default_rng(4)
    steps = rng.multivariate_normal(drift, spread, size=20_000)
    values = np.exp(np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]))
    growth = pc.experiments.market(values, rate=0.0).perturbation.growth
    errors = np.sqrt(np.diag(spread) / 20_000)
    assert np.all(np.abs(np.asarray(growth.log_mean) - drift) < 5 * errors)
    centred = steps - drift
    assert_mean_is(centred[:, :, None] * centred[:, None, :], spread)
    assert np.abs(np.asarray(growth.log_covariance) / spread - 1).max() < 0.2


@pytest.fixture(scope="module")
def small():
    return pc.experiments.market(prices(2, days=81), HORIZON, capital=200.0)


def test_expected_cost_matches_the_dense_moment_oracle(small):
    """Example 1 of the paper in the oracle's terms, with drifts and correlations of the stocks' own."""
    growth, T, L = small.perturbation.growth, HORIZON, 3
    g, C = np.asarray(growth.mean), np.asarray(growth.covariance)
    M, deployed = (np.asarray(small.feasible_set.project(normal(seed, 1, L, L))) for seed in (1, 2))
    portfolio = deployed[0] / EXPOSURE
    shown = np.kron(np.diag([1.0, 0.0]), np.eye(L))
    down, right = np.vstack([np.eye(L), np.eye(L)]), np.hstack([np.zeros((L, L)), np.eye(L)])
    expected = expected_cost_moments(
        A=np.broadcast_to(np.eye(2 * L), (T, 2 * L, 2 * L)),
        B=np.broadcast_to(np.eye(2 * L), (T, 2 * L, 2 * L)),
        K=np.zeros((T + 1, 2 * L, 2 * L)),
        Q=np.broadcast_to(shown, (T + 1, 2 * L, 2 * L)),
        R=np.broadcast_to(shown, (T + 1, 2 * L, 2 * L)),
        M=np.kron(np.eye(2), M[0])[None],
        noise_mean=np.broadcast_to(np.asarray(small.noise.mean), (T, 2 * L)),
        noise_covariance=np.broadcast_to(np.asarray(small.noise.covariance), (T, 2 * L, 2 * L)),
        perturbation_mean=np.broadcast_to(np.diag(np.tile(portfolio @ g - 1, 2)), (T, 2 * L, 2 * L)),
        covariance_apply=lambda t, X: down @ (portfolio @ C @ portfolio.T * (right @ X @ right.T)) @ down.T,
        initial_mean=np.repeat([0.0, 200.0], L),
        initial_covariance=np.zeros((2 * L, 2 * L)),
    )
    assert float(pc.expected_cost(small, M, deployed=deployed)) == pytest.approx(expected, rel=1e-11)


def test_realised_cost_matches_accounts_kept_by_hand(small):
    """Every account is split by its row of the portfolio, grows with the stocks, and takes the risk; in plain NumPy."""
    later = prices(9, days=HORIZON + 1)
    days = recorded_days(later, 0.05, 6.5)
    M = np.asarray(small.feasible_set.project(normal(1, 1, 3, 3)))
    portfolio, law = M[0] / EXPOSURE, small.perturbation.growth
    mean_risk = np.asarray(small.noise.law.mean)
    held, expected, cost = np.full(3, 200.0), np.full(3, 200.0), 0.0
    before, before_mean = np.zeros(3), np.zeros(3)  # the policy acts on the risk of the day before
    for day in range(HORIZON + 1):
        act = M[0] @ (before - before_mean)
        cost += np.sum((held - expected) ** 2) + np.sum(act**2)
        if day == HORIZON:
            break
        growth, risk = later[day + 1] / later[day] * np.exp(-0.05 / 252), days.risk[day]
        np.testing.assert_allclose(risk, 100 * 17.5 / 24 * (growth - 1))
        held = held * (portfolio @ growth) + M[0] @ before + risk
        expected = expected * (portfolio @ np.asarray(law.mean)) + M[0] @ before_mean + mean_risk
        before, before_mean = risk, mean_risk
    assert realised_cost(small, M, days) == pytest.approx(cost, rel=1e-10)


def test_mean_of_realised_costs_is_the_expected_cost_where_days_follow_the_model():
    problem = pc.experiments.market(prices(2, days=81), HORIZON, capital=1e4)  # returns outweigh the risk
    law = problem.perturbation.growth
    rng = np.random.default_rng(0)
    M = np.full((1, 3, 3), EXPOSURE / 3)
    known, costs = np.asarray(problem.noise.law.samples), []
    for _ in range(400):
        factor = np.linalg.cholesky(np.asarray(law.log_covariance))
        growth = np.exp(np.asarray(law.log_mean) + rng.normal(size=(HORIZON, 3)) @ factor.T)
        risk = known[rng.integers(len(known), size=HORIZON)]
        costs.append(realised_cost(problem, M, type(recorded_days(prices(), 0, 1))(growth, risk)))
    assert_mean_is(np.array(costs), float(pc.expected_cost(problem, M)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("long_only", [False, True])
def test_minimum_variance_matches_another_solver(seed, long_only):
    covariance = 1e-4 * np.asarray(random_psd(seed, 6), dtype=float)
    w = cvxpy.Variable(6)
    constraints = [cvxpy.sum(w) == 1, *([w >= 0] if long_only else [])]
    cvxpy.Problem(cvxpy.Minimize(cvxpy.quad_form(w, 1e4 * covariance)), constraints).solve(solver="CLARABEL")
    ours = minimum_variance(covariance, long_only)
    assert ours.sum() == pytest.approx(1.0) and (ours.min() >= 0 or not long_only)
    assert ours @ covariance @ ours <= w.value @ covariance @ w.value * (1 + 1e-9)
    np.testing.assert_allclose(ours, w.value, atol=1e-3)


@pytest.mark.parametrize("feasible_set", ["rows", "simplex"])
def test_allocations_are_feasible_and_are_what_they_are_called(feasible_set):
    problem = pc.experiments.market(prices(2, days=81), HORIZON, feasible_set=feasible_set)
    found = allocations(problem)
    assert tuple(found.policies) == tuple(found.costs) == ALLOCATIONS
    for name, M in found.policies.items():
        assert bool(problem.feasible_set.contains(jnp.asarray(M), 1e-9)), name
        assert found.costs[name] == pytest.approx(float(pc.expected_cost(problem, M)), rel=1e-12)
    assert found.costs["optimal"] <= min(found.costs.values()) * (1 + 1e-12)
    stable, equal = found.policies["stable"], found.policies["equal weight"]
    assert_close(pc.best_response(problem, stable), stable, 1e-6)
    assert_close(pc.best_response(problem, equal), found.policies["naive"], 1e-6)
    assert 0 <= found.rate < 1 and found.residual < 1e-6


# --- out of sample ---------------------------------------------------------------------------------------------------


def test_windows_are_judged_on_days_that_they_were_not_estimated_from():
    values = prices(5, days=121)
    settings = {"horizon": HORIZON, "window": 80, "capital": 200.0}
    rolled = rolling_windows(values, count=None, **settings)
    np.testing.assert_array_equal(rolled.first, [80, 88, 96, 104, 112])
    np.testing.assert_array_equal(rolled.last - rolled.first, HORIZON)
    changed = values.copy()
    changed[105:] *= np.linspace(1, 1.3, 16)[:, None]  # after the fourth estimate, before the fifth
    other = rolling_windows(changed, count=None, **settings)
    np.testing.assert_array_equal(other.predicted[:4], rolled.predicted[:4])
    np.testing.assert_array_equal(other.realised[:3], rolled.realised[:3])
    assert np.all(other.realised[3] != rolled.realised[3]) and np.all(other.predicted[4] != rolled.predicted[4])
    last = rolling_windows(values, count=1, **settings)
    problem = pc.experiments.market(values[32:113], HORIZON, capital=200.0)
    found = allocations(problem)
    for index, name in enumerate(ALLOCATIONS):
        assert last.predicted[0, index] == pytest.approx(found.costs[name], rel=1e-6)
        cost = realised_cost(problem, found.policies[name], recorded_days(values[112:], 0.05, 6.5))
        assert last.realised[0, index] == pytest.approx(cost, rel=1e-4)


def test_reaction_grows_with_capital_and_the_optimum_tends_to_minimum_variance():
    swept = capital_sweep(prices(2, days=81), [1000.0, 10.0, 100.0, 1e5], horizon=HORIZON, feasible_set="simplex")
    np.testing.assert_array_equal(swept.capital, [10.0, 100.0, 1000.0, 1e5])
    assert np.all(np.diff(swept.rate[:3]) > 0)
    excess = swept.costs[:, 3] / swept.costs[:, 4]
    assert np.all(excess >= 1 - 1e-12) and excess[0] < excess[2]
    gap = np.abs(swept.portfolio[:, 4] - swept.portfolio[:, 1]).max(axis=1)
    assert gap[3] < 0.01 < gap[0]


def test_command_gives_the_same_numbers_as_the_library(tmp_path):
    values = prices(5, days=121)
    path = tmp_path / "prices.csv"
    path.write_text("\n".join(lines(values)))
    arguments = ["--horizon", "8", "--window", "80", "--windows", "2", "--no-sweep", "--capital", "200"]
    result = CliRunner().invoke(app, ["stocks", str(path), *arguments, "--json"])
    assert result.exit_code == 0, result.stderr
    data = json.loads(result.stdout)
    problem = pc.experiments.market(values[-81:], HORIZON, capital=200.0)
    found = allocations(problem, starts=4)
    for name in ALLOCATIONS:
        assert data["allocations"][name]["expected_cost"] == pytest.approx(found.costs[name], rel=1e-6)
        assert sum(data["allocations"][name]["weights"]) == pytest.approx(1.0)
    assert data["out_of_sample"]["equal weight"] | {"ratio": 1.0, "windows": 2} == data["out_of_sample"]["equal weight"]
    assert len(data["windows"]) == 2 and data["windows"][1]["last_day"] == data["last_day"]
    assert "spectral radius" in data["certificate"] and data["capital_sweep"] is None


def test_command_writes_data_tables_and_figures(tmp_path):
    values = prices(5, days=121)
    path, out = tmp_path / "prices.csv", tmp_path / "deep" / "out"
    path.write_text("\n".join(lines(values)))
    arguments = ["--horizon", "8", "--window", "80", "--windows", "2", "--out", str(out)]
    shown = CliRunner().invoke(app, ["stocks", str(path), *arguments])
    assert shown.exit_code == 0, shown.stderr
    figures = {f"{name}.{kind}" for name in ("allocations", "windows", "capital") for kind in ("png", "svg")}
    assert {file.name for file in out.iterdir()} == {"stocks.json", "stocks.md", "weights.csv", *figures}
    data = json.loads((out / "stocks.json").read_text())
    assert [point["capital"] for point in data["capital_sweep"]] == pytest.approx(
        150 * 10 ** np.arange(-1.5, 1.25, 0.5)
    )
    table = [line.split(",") for line in (out / "weights.csv").read_text().splitlines()]
    assert table[0] == ["stock", *ALLOCATIONS] and [row[0] for row in table[1:]] == data["stocks"]
    for column, name in enumerate(ALLOCATIONS, 1):
        weights = [float(row[column]) for row in table[1:]]
        np.testing.assert_allclose(weights, data["allocations"][name]["weights"], atol=1e-6)
        cost = f"{data['allocations'][name]['expected_cost']:.4g}"
        assert f"| {name} | {cost} |" in (out / "stocks.md").read_text()
        assert name in shown.stdout
    for name in ("allocations", "windows", "capital"):
        assert plt.imread(out / f"{name}.png").shape[1] > 900


def test_command_shows_where_no_stable_allocation_was_found(tmp_path, monkeypatch):
    """Weights unknown, no certificate, the other allocations as ever; figures and tables leave it out."""
    monkeypatch.setattr("perfcontrol.experiments.prices.allocations.StablePoint", lambda tolerance: pc.RRM(1e-14, 1))
    path, out = tmp_path / "prices.csv", tmp_path / "out"
    path.write_text("\n".join(lines(prices(5, days=121))))
    arguments = ["--horizon", "8", "--window", "80", "--windows", "1", "--json", "--out", str(out)]
    result = CliRunner().invoke(app, ["stocks", str(path), *arguments])
    assert result.exit_code == 0, result.stderr
    data = json.loads(result.stdout)
    assert data["allocations"]["stable"] == {"weights": [None] * 3, "expected_cost": None}
    assert data["certificate"] is None and data["rate"] is None
    assert data["out_of_sample"]["stable"] == dict.fromkeys(data["out_of_sample"]["stable"]) | {
        "windows": 0,
        "cheaper": 0,
    }
    assert data["out_of_sample"]["optimal"]["windows"] == 1
    assert "No stable policy was found." in (out / "stocks.md").read_text()
    assert (out / "weights.csv").read_text().splitlines()[1].split(",")[4] == ""


REFUSED = {
    "gaps": (lambda: pc.experiments.market(np.full((80, 3), np.nan)), "prices", "read_prices"),
    "one stock": (lambda: pc.experiments.market(prices()[:, :1]), "prices", "two stocks"),
    "a vector": (lambda: pc.experiments.market(np.ones(90)), "prices", "(90,)"),
    "not positive": (lambda: pc.experiments.market(prices() - 60), "prices", "be positive", "stock 0"),
    "too few days": (lambda: pc.experiments.market(prices(days=30)), "prices", "30 days"),
    "a split": (lambda: pc.experiments.market(prices() * np.repeat([[2.0], [1.0]], 35, axis=0)), "prices", "row 35"),
    "treatment": (lambda: pc.experiments.market(prices(), splits="mend"), "splits", "'mend'"),
    "horizon": (lambda: pc.experiments.market(prices(), horizon=1), "horizon", "at least 2"),
    "no capital": (lambda: pc.experiments.market(prices(), capital=0), "capital", "positive"),
    "capital of many": (lambda: pc.experiments.market(prices(), capital=[1.0, 2.0]), "capital", "one number"),
    "rate": (lambda: pc.experiments.market(prices(), rate=float("nan")), "rate", "finite"),
    "hours": (lambda: pc.experiments.market(prices(), trading_hours=25), "trading_hours", "between 0 and 24"),
    "set": (lambda: pc.experiments.market(prices(), feasible_set="ball"), "feasible_set", "'ball'"),
    "no window": (lambda: rolling_windows(prices(), window=65, horizon=8), "prices", "65 + 8 days"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_market_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
