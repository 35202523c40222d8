"""The commands about problem files: what they print and keep, their exit statuses, and how they go on."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import perfcontrol as pc
from perfcontrol.cli import app, plans
from perfcontrol.cli.new import TEMPLATES
from perfcontrol.cli.solve import _boundary
from perfcontrol.results import load_dataset
from tests.solvers.problems import performative_prediction

SMALL = """\
horizon = 3
solver = { type = "RSGD", steps = 1200, step_size = 0.01, batch = 1 }
system = { A = [[0.5]], B = [[1.0]] }
noise = { type = "Rademacher", scale = 1.0 }
cost = { type = "QuadraticCost", Q = [[1.0]], R = [[1.0]] }
[perturbation]
type = "DirectionalPerturbation"
directions = "D.npy"
scale = { type = "Norm", offset = [0.1], weight = [0.2], squared = true }
"""


@pytest.fixture
def file(tmp_path):
    np.save(tmp_path / "D.npy", np.ones((1, 1, 1)))
    (tmp_path / "problem.toml").write_text(SMALL)
    return tmp_path / "problem.toml"


def run(*arguments, status=0):
    result = CliRunner().invoke(app, ["--no-cache", *map(str, arguments)])
    assert result.exit_code == status, result.output
    return result


def said(*arguments, status=0):
    """What a command prints as JSON."""
    return json.loads(run(*arguments, "--json", status=status).stdout)


def test_new_writes_files_that_run_and_overwrites_none(tmp_path):
    path = tmp_path / "mine.toml"
    assert f"perfcontrol solve {path}" in run("new", path).stdout.replace("\n", "")
    assert path.read_bytes() == TEMPLATES["reacting"].read_bytes()
    assert "--force" in run("new", path, status=2).stderr
    run("new", path, "--force", "--template", "learning")
    assert path.read_bytes() == TEMPLATES["learning"].read_bytes()
    assert "must be one of" in run("new", tmp_path / "b.toml", "--template", "x", status=2).stderr
    assert "must end in .toml" in run("new", tmp_path / "b.txt", status=2).stderr


def test_solve_does_what_the_same_program_does_and_keeps_it(file, tmp_path):
    found = said("solve", file, "--set", "solver.steps=30", "--seed", 7, "--no-certify", "--out", tmp_path / "run")
    problem, solver = pc.load(file), pc.RSGD(30, 0.01)
    solution = pc.solve(problem, solver, key=jax.random.key(7))
    np.testing.assert_array_equal(found["policy"], solution.M)
    assert found["cost"] == pytest.approx(float(pc.expected_cost(problem, solution.M)), rel=1e-12)
    kept = pc.load(tmp_path / "run")
    np.testing.assert_array_equal(kept.solution.history, solution.history)
    assert (kept.seed, kept.solver.steps, kept.problem.horizon) == (7, 30, 3)
    assert kept.history.sizes["step"] == 31
    assert "which holds" in run("solve", file, "--out", tmp_path / "run", status=2).stderr
    assert "has ended" in run("resume", tmp_path / "run").stdout
    assert "perfcontrol new nowhere.toml" in run("solve", "nowhere.toml", status=2).stderr.replace("\n", " ")


def test_solve_says_where_the_feasible_set_holds_the_policy_back():
    ball = performative_prediction(0.5, feasible_set=pc.FrobeniusBall(2.0))
    rows = performative_prediction(0.5, feasible_set=pc.RowSum(2.0))
    (line,) = _boundary(ball, jnp.full(ball.policy_shape, -2.0))
    assert "boundary" in line
    assert _boundary(ball, jnp.full(ball.policy_shape, 1.9)) == _boundary(rows, jnp.full(rows.policy_shape, 2.0)) == []


def test_solve_says_what_is_certified_and_ends_with_one_where_the_method_fails(file, tmp_path):
    found = said("solve", file, "--set", "solver=StablePoint", "--out", tmp_path / "run")
    assert found["success"] and found["stats"]["residual"] < 1e-11
    assert {row["kind"]: row["exists"] for row in found["certificates"]}["sharp"] is True
    assert pc.load(tmp_path / "run").certificates == tuple(found["certificates"])
    text = run(
        "solve", tmp_path / "run", "--no-certify", "--set", "solver={type='RSGD', steps=50, step_size=9.0}", status=1
    )
    assert "grew past the divergence threshold" in text.stdout.replace("\n", " ")


def test_a_folder_in_which_another_process_works_is_refused(file, tmp_path):
    from perfcontrol._lock import locked

    with locked("out", tmp_path / "run"):
        for command in (("solve", file, "--out"), ("sweep", file, "--vary", "horizon=3", "--out")):
            assert "no other run works in" in run(*command, tmp_path / "run", status=2).stderr.replace("\n", " ")


class Stopped(BaseException):
    """A kill, as far as files are concerned."""


def test_a_stopped_solve_goes_on_to_the_same_bits(file, tmp_path, monkeypatch):
    whole = said("solve", file, "--no-certify", "--out", tmp_path / "whole")
    monkeypatch.setattr("perfcontrol.solvers.checkpoint.PAUSE", 0)
    real, drawn = plans.solved, []

    def stopping(plan, progress, kinds, checkpoint):
        def stop(stage, share):
            drawn.append(share)
            if share > 0.4:
                raise Stopped
            progress(stage, share)

        return real(plan, stop, kinds, checkpoint)

    monkeypatch.setattr("perfcontrol.cli.solve.solved", stopping)
    with pytest.raises(Stopped):
        CliRunner().invoke(app, ["--no-cache", "solve", str(file), "--no-certify", "--out", str(tmp_path / "run")])
    assert drawn and "has not ended" in run("simulate", tmp_path / "run", status=2).stderr.replace("\n", " ")
    monkeypatch.setattr("perfcontrol.cli.solve.solved", real)
    assert said("resume", tmp_path / "run")["policy"] == whole["policy"]
    one, other = (pc.load(tmp_path / name) for name in ("run", "whole"))
    np.testing.assert_array_equal(one.solution.history, other.solution.history)
    names = [sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("run", "whole")]
    assert names[0] == names[1] and "checkpoint" not in names[0]


def test_a_stopped_sweep_keeps_its_points_and_solves_the_others(file, tmp_path, monkeypatch):
    real, solved = plans.solved, []

    def counting(plan, progress):
        if len(solved) == 2:
            raise Stopped
        solved.append(plan)
        return real(plan, progress)

    monkeypatch.setattr("perfcontrol.cli.together.solved", counting)
    grid = ["--vary", "perturbation.scale.weight.0=0:0.4:2", "--vary", "solver=StablePoint,RRM"]
    with pytest.raises(Stopped):
        CliRunner().invoke(app, ["--no-cache", "sweep", str(file), *grid, "--out", str(tmp_path / "sweep")])
    assert pc.load(tmp_path / "sweep").attrs == {"finished": 2, "points": 4}
    file.unlink()
    (tmp_path / "D.npy").unlink()  # the folder has copies of its own
    solved.clear()
    rows = said("resume", tmp_path / "sweep")
    assert len(solved) == 2 and [row["solver"] for row in rows] == 2 * ["StablePoint", "RRM"]
    grid = pc.load(tmp_path / "sweep")
    assert dict(grid.cost.sizes) == {"perturbation.scale.weight.0": 2, "solver": 2}
    assert grid["solver"].values.tolist() == ["StablePoint", "RRM"] and bool(grid.success.all())
    np.testing.assert_allclose(grid.policy.sel(solver="RRM"), grid.policy.sel(solver="StablePoint"), atol=1e-9)
    assert float(abs(grid.policy[0, 0] - grid.policy[1, 0]).max()) > 1e-4
    assert load_dataset(tmp_path / "sweep" / "results.nc").cost.equals(grid.cost)


def test_runs_that_differ_in_numbers_are_solved_together_each_as_alone_and_again_to_the_same_bits(
    file, tmp_path, monkeypatch
):
    """Three points in blocks of two; one point is lost, as a kill between two points leaves it."""
    monkeypatch.setattr("perfcontrol.cli.together.TOGETHER", 2)
    monkeypatch.setattr("perfcontrol.cli.together.solved", None)  # nothing is solved alone
    vary, folder = "perturbation.scale.weight.0", tmp_path / "sweep"
    run("sweep", file, "--vary", f"{vary}=0,0.2,0.4", "--set", "solver.steps=30", "--out", folder)
    before = {path.name: path.read_bytes() for path in (folder / "points").glob("*.npz")}
    monkeypatch.undo()
    for number, weight in enumerate((0, 0.2, 0.4)):
        alone = said("solve", file, "--no-certify", "--set", "solver.steps=30", "--set", f"{vary}={weight}")
        np.testing.assert_allclose(pc.load(folder / "points" / f"{number:06d}.npz").M, alone["policy"], rtol=1e-12)
    monkeypatch.setattr("perfcontrol.cli.together.TOGETHER", 2)
    for suffix in ("json", "npz"):
        (folder / "points" / f"000001.{suffix}").unlink()
    run("resume", folder)
    for path in (folder / "points").glob("*.npz"):
        np.testing.assert_array_equal(pc.load(path).history, _history(before[path.name], tmp_path))
    assert len(before) == 3


def _history(content, tmp_path):
    (tmp_path / "before.npz").write_bytes(content)
    return pc.load(tmp_path / "before.npz").history


@pytest.mark.parametrize(
    ("vary", "words"),
    [
        ("horizon", "be key=value,value"),
        ("horizon=3,3", "give every value once"),
        ("horizon=3:4:1000000000", "have 2 to 100000 numbers"),
        ("horizon=3,x", "be values that the problem takes"),
        ("cost.P=3", "no key of QuadraticCost"),
    ],
)
def test_wrong_grids_are_refused_before_any_work(vary, words, file, tmp_path):
    stderr = run("sweep", file, "--vary", vary, "--out", tmp_path / "sweep", status=2).stderr
    assert words in stderr.replace("\n", " ")
    assert not (tmp_path / "sweep").exists()


def test_compare_has_a_row_for_every_method_and_says_which_do_not_apply(file, tmp_path):
    anderson = "{ type = 'RRM', anderson = 2 }"
    cut = "{ type = 'RSGD', steps = 3, step_size = 0.1, truncation = 9 }"  # for infinite horizons alone
    methods = ["--solver", "StablePoint", "--solver", "RRM", "--solver", anderson, "--solver", cut]
    rows = said("compare", file, "--set", "solver.steps=5", *methods, "--out", tmp_path / "all", status=1)
    assert [row["name"] for row in rows] == ["RSGD", "StablePoint", "RRM", "RRM-2", "RSGD-2"]
    assert rows[4]["result"].startswith("does not apply: ") and "truncation" in rows[4]["result"]
    assert rows[1]["cost"] == pytest.approx(rows[2]["cost"]) and rows[1]["residual"] < 1e-11
    assert pc.load(tmp_path / "all" / "RRM-2").solver.anderson == 2
    assert "`--solver`" in run("compare", file, "--solver", "RRN", status=2).stderr
    shown = run("compare", file, "--set", "solver.steps=5", "--solver", "StablePoint").stdout
    assert "StablePoint" in shown and "ended as asked" in shown


def test_simulate_agrees_with_the_exact_cost_and_writes_the_paths(file, tmp_path):
    np.save(tmp_path / "M.npy", [[[0.2]]])
    np.save(tmp_path / "other.npy", [[[-0.4]]])
    options = ("--policy", tmp_path / "M.npy", "--deployed", tmp_path / "other.npy", "--samples", 4000)
    found = said("simulate", file, *options, "--out", tmp_path / "paths.nc")
    exact = pc.expected_cost(pc.load(file), [[[0.2]]], deployed=[[[-0.4]]])
    assert abs(found["mean_cost"] - exact) < 5 * found["standard_error"]
    assert found["expected_cost"] == pytest.approx(float(exact), rel=1e-12)
    paths = load_dataset(tmp_path / "paths.nc")
    assert paths.x.shape == (4000, 4, 1) and float(paths.cost.mean()) == pytest.approx(found["mean_cost"])
    assert "mean" in run("simulate", file, "--samples", 10).stdout
    assert "end in .nc" in run("simulate", file, "--out", tmp_path / "paths.csv", status=2).stderr


def test_certify_reads_files(file, monkeypatch):
    (row,) = said("certify", file, "--kind", "sharp")
    monkeypatch.chdir(file.parent)
    assert file.name == "problem.toml" and said("certify", "--kind", "sharp") == [row]  # as the other commands do
    assert row["exists"] is True and row["rate"] < 1
    assert "does not exist" in run("certify", "nothing.toml", status=2).stderr


def test_schema_is_printed_or_written(tmp_path):
    assert json.loads(run("schema").stdout)["title"] == "A performative control problem"
    run("schema", "--out", tmp_path / "s.json")
    assert json.loads((tmp_path / "s.json").read_text()) == json.loads(run("schema").stdout)
