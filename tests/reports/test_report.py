"""A report says the numbers of the library, in a page that needs nothing else, whatever the problem is."""

import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import perfcontrol as pc
from perfcontrol.cli import app
from tests.reports.pages import check
from tests.solvers.problems import performative_prediction
from tests.theory.problems import order_problem, random_problem
from tests.tools import assert_refused

SECTIONS = [
    "problem",
    "existence",
    "costs",
    "convergence",
    "policy",
    "trajectories",
    "distribution",
    "contributions",
    "landscape",
    "computed",
]


def closest(values, wanted):
    return min(abs(value - wanted) / abs(wanted) for value in values)


def reacting(**changes) -> pc.PerformativeProblem:
    """Scalar, its volatility growing with the policy: every certificate applies, and the three policies differ."""
    parts = {
        "system": pc.LinearSystem([[0.8]], [[1.0]], ["stock of <a> & b"], ["order"]),
        "horizon": 6,
        "noise": pc.Rademacher(1.0),
        "cost": pc.QuadraticCost([[1.0]], [[1.0]]),
        "perturbation": pc.DirectionalPerturbation([[[1.0]]], pc.Affine([0.3], [[[[0.4]]]])),
        "feasible_set": pc.FrobeniusBall(2.0),
    }
    return pc.PerformativeProblem(**(parts | changes))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    problem = reacting()
    diverged = pc.solve(problem, pc.RSGD(steps=20, step_size=0.02), key=jax.random.key(0))
    path = tmp_path_factory.mktemp("report") / "report.html"
    seen = []
    runs = {"descent": diverged, "exact": pc.solve(problem, pc.StablePoint())}
    made = pc.report(problem, runs, path, samples=64, progress=lambda part, share: seen.append((part, share)))
    return problem, runs, made, path, seen


def test_page_has_every_section_and_figure_and_is_written_whole(made):
    _, _, report, path, seen = made
    assert path.read_text(encoding="utf-8") == report.html
    page = check(report.html)
    assert list(page.sections) == SECTIONS
    assert report.missing == {}
    # convergence, 4 policies, 2 signals, costs, 3 certificates by contribution, 2 views of the landscape: one parameter
    assert len(page.drawings) == 1 + 4 + 2 + 1 + 3 + 2
    assert page.paths > 300
    parts = [part for part, share in seen if share == 0]
    assert [part for part, share in seen if share == 1] == parts == list(report.seconds)
    assert "stock of &lt;a&gt; &amp; b" in report.html
    assert report._repr_html_().startswith("<iframe title=")


def test_numbers_of_the_page_are_those_of_the_library(made):
    problem, _, report, _, _ = made
    page = check(report.html)
    price = pc.price_of_stability(problem)
    for number in (price.cost_naive, price.cost_stable, price.cost_optimal, price.ratio, price.bound.lower):
        assert closest(page.values, number) < 1e-9
    for kind in ("paper", "rigorous", "global", "sharp"):
        certificate = pc.certify(problem, kind)
        assert certificate.applicable
        assert closest(page.values, certificate.lhs) < 1e-6
        assert certificate.verdict.split("(")[0] in page.sections["existence"].replace("  ", " ")
    paths = pc.simulate(problem, price.stable, key=jax.random.key(0), samples=64)
    assert closest(page.values, float(np.quantile(np.asarray(paths.cost), 0.95))) < 1e-9
    assert "A stable policy exists (proved)" in page.sections["existence"]
    assert "The run “exact” found the stable policy" in page.sections["costs"]


def test_time_that_is_used_up_leaves_out_parts_and_names_them():
    report = pc.report(reacting(), samples=8, seconds=0)
    page = check(report.html)
    assert list(page.sections) == SECTIONS
    assert "certificate sharp" in report.missing and "0 s that were allowed" in report.missing["paths"]
    assert page.sections["trajectories"].count("Not shown.") == 1
    assert "sharp: The 0 s" in page.sections["existence"]


def test_problem_without_stable_policy_says_so():
    problem = performative_prediction(1.0)  # Φ(M) = 10 + M
    failed = pc.solve(problem, pc.RRM(max_steps=30), throw=False)
    recorded = pc.solve(problem, pc.RRM(max_steps=3), throw=False, record=lambda M: M.sum())
    report = pc.report(problem, {"RRM": failed, "sums": recorded}, samples=16)
    page = check(report.html)
    assert "No stable policy exists" in page.sections["existence"]
    assert "have a stable policy" in report.missing["policies"]
    assert pc.Result[failed.result].split(":")[0][:20] in page.sections["convergence"]
    assert "holds no iterates" in page.sections["convergence"]
    assert "exact costs of all three" in page.sections["landscape"]
    assert "no certificate that splits" in page.sections["contributions"].lower()


def test_what_only_simulation_knows_is_reported_with_standard_errors():
    problem = reacting(cost=pc.ConvexCost(lambda t, x, u: x @ x + u @ u))
    report = pc.report(problem, samples=200)
    page = check(report.html)
    exact = pc.price_of_stability(reacting())
    assert "±" in page.sections["costs"] and "standard errors" in page.sections["costs"]
    assert closest(page.values, exact.cost_stable) < 0.2
    assert "known only by samples" in page.sections["landscape"]


def test_run_that_was_kept_is_reported_from_its_folder_by_the_command_line(tmp_path, monkeypatch):
    monkeypatch.setattr("perfcontrol.cli.report.configure_jax", lambda: None)
    problem = reacting()
    solver = pc.RSGD(steps=40, step_size=0.02)
    solution = pc.solve(problem, solver, key=jax.random.key(5), every=4)
    pc.save(pc.Run(problem, solution, solver, seed=5, every=4), tmp_path / "run")
    done = CliRunner().invoke(app, ["report", str(tmp_path / "run"), "--samples", "32", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["missing"] == {}
    page = check((tmp_path / "run" / "report.html").read_text(encoding="utf-8"))
    assert "The run “RSGD” ended after 40 steps" in page.source
    assert "seed 5," in page.sections["computed"]
    assert page.headings[0][1] == "Performative control: run"


@pytest.mark.slow
def test_infinite_horizon_is_reported_per_stage():
    problem = reacting(horizon=math.inf, noise=pc.Gaussian([0.0], [[1.0]]))
    report = pc.report(problem, samples=16)
    page = check(report.html)
    assert "on average per stage" in page.sections["costs"]
    assert closest(page.values, pc.price_of_stability(problem).cost_stable) < 1e-9
    assert "cut off after 200 steps" in page.sections["trajectories"]
    assert "the horizon is infinite" in page.sections["existence"]


@pytest.mark.slow
@pytest.mark.parametrize("growth", [0.9, 1.0])
def test_twenty_states_on_a_simplex_are_reported_below_two_megabytes(growth):
    problem = pc.experiments.stock_market("descending", growth=growth, feasible_set="simplex")
    report = pc.report(problem, samples=64)
    page = check(report.html)
    assert len(report.html) < 1_500_000
    assert "6 of 40 signals" in page.sections["trajectories"]


@pytest.mark.slow
def test_long_horizons_and_many_sensitivities_stay_small():
    problem = order_problem(np.linspace(1e-6, 1e-5, 2000))
    assert len(pc.report(problem, samples=32).html) < 1_500_000


def test_wrong_arguments_are_refused_before_work(tmp_path: Path):
    problem = reacting()
    solution = pc.solve(problem, pc.StablePoint())
    assert_refused(lambda: pc.report(solution), "problem", "pc.report(problem, solution)")
    assert_refused(lambda: pc.report(problem, solution.M), "solution")
    assert_refused(lambda: pc.report(random_problem(0), solution), "solution", "shape")
    assert_refused(lambda: pc.report(problem, seconds=-1.0), "seconds")
    assert_refused(lambda: pc.report(problem, samples=1), "samples")
    assert_refused(lambda: pc.report(problem, seed=-1), "seed")
    assert_refused(lambda: pc.report(None), "problem")
    with pytest.raises(OSError):
        pc.report(problem, path=tmp_path, samples=2)
    batch = jax.vmap(lambda key: pc.solve(problem, pc.RSGD(steps=5, step_size=0.01), key=key))
    assert_refused(lambda: pc.report(problem, batch(jax.random.split(jax.random.key(0), 2))), "solution")
    assert jnp.isfinite(solution.M).all()
