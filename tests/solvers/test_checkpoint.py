"""A run kept in a folder: stopped anywhere, the same call ends with the same bits; what is not its own is refused."""

import json
import resource
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import perfcontrol as pc
from perfcontrol._lock import locked
from perfcontrol.solvers import checkpoint, history, run_folder
from perfcontrol.solvers.runs import CHUNK
from tests.solvers.problems import drifting, performative_prediction, steered, strongly_performative
from tests.solvers.test_solve import Walk
from tests.tools import assert_refused

KEY = jax.random.key(5)
LONG = 2 * CHUNK + 207


class StoppedError(Exception):
    """Raised in a run's progress, as a user would interrupt it."""


def stop_at(call):
    """A progress function that stops the run at its call of this number."""
    calls = []

    def progress(done, total):
        calls.append(done)
        if len(calls) == call:
            raise StoppedError

    return progress


def bits(solution):
    return [
        (np.asarray(leaf).dtype.str, np.asarray(leaf).shape, np.asarray(leaf).tobytes())
        for leaf in jax.tree.leaves(solution)
    ]


@pytest.fixture(autouse=True)
def _saved_at_every_border(monkeypatch):
    monkeypatch.setattr(checkpoint, "PAUSE", 0)
    monkeypatch.setattr(history, "PIECE", 1000)  # so that rows are written in several pieces


def two_numbers(M):
    return {"sum": M.sum(), "signs": M > 0}


def ball():
    return pc.FrobeniusBall(3.0)


RUNS = {
    "chunks": (lambda: performative_prediction(0.5), Walk(LONG), {}, 2),
    "records": (lambda: performative_prediction(0.5), Walk(LONG), {"every": 7, "record": two_numbers}, 2),
    "ends early": (lambda: performative_prediction(0.5), Walk(LONG, CHUNK + 9, pc.Result.diverged), {"every": 7}, 1),
    "adam": (drifting, pc.RSGD(LONG, 1e-3, transform=optax.scale_by_adam(), schedule=pc.Lazy(3)), {}, 2),
    "average": (steered, pc.RSGD(LONG, pc.PowerStep(0.02, 0.6), average=True), {"every": 3}, 2),
    "batch means": (steered, pc.RSGD(LONG, 0.01, average=pc.Average(covariance="batch means")), {}, 1),
    "repeated minimisation": (drifting, pc.RRM(), {"every": 2}, 3),
    "anderson": (drifting, pc.RRM(anderson=2), {}, 3),
    "stable point": (strongly_performative, pc.StablePoint(), {"key": None}, 4),
    "sampled": (drifting, pc.RRM(tolerance=0.2), {"sampled": True}, 2),
    "continuation": (lambda: drifting(feasible_set=ball()), pc.Continuation(), {"key": None}, 3),
    "optimum": (steered, pc.PerformativeOptimum(starts=2), {"key": None}, 2),
}  # fmt: skip


LATER = ("optimum", "sampled", "continuation", "batch means")  # take longest to compile


def sampled(problem):
    """The same without known moments."""
    cost = pc.ConvexCost(lambda t, x, u: x @ x + u @ u, strong_convexity=2.0)
    return pc.PerformativeProblem(
        system=problem.system, horizon=problem.horizon, noise=problem.noise, cost=cost, memory=problem.memory,
        gain=problem.gain, perturbation=problem.perturbation, initial_state=problem.initial_state,
    )  # fmt: skip


@pytest.mark.float32
@pytest.mark.filterwarnings("ignore::perfcontrol.UnstableGainWarning")
@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.slow] * (case in LATER)) for case in RUNS])
def test_run_that_was_stopped_ends_with_the_bits_of_one_that_was_not(tmp_path, case):
    build, solver, settings, call = RUNS[case]
    problem, settings = build(), {"key": KEY, "throw": False} | settings
    if settings.pop("sampled", False):
        problem = sampled(problem)
    whole = pc.solve(problem, solver, **settings)
    folder = tmp_path / "run"
    with pytest.raises(StoppedError):
        pc.solve(problem, solver, checkpoint=folder, progress=stop_at(call), **settings)
    assert not (folder / "solution.npz").exists()
    seen = []
    again = pc.solve(problem, solver, checkpoint=folder, progress=lambda done, total: seen.append(done), **settings)
    assert bits(again) == bits(whole) and again.result == whole.result
    # What was done before was not done again.
    first = [call * CHUNK] if case in ("chunks", "adam", "batch means") else []
    assert not first or seen[0] == min(first[0] + CHUNK, LONG)


@pytest.mark.filterwarnings("ignore::perfcontrol.UnstableGainWarning")
def test_rescue_is_resumed_like_the_run_before_it(tmp_path, monkeypatch):
    # One step of Newton's method never arrives; continuation does.
    problem, solver = drifting(feasible_set=ball()), pc.StablePoint(max_steps=1)
    whole = pc.solve(problem, solver)
    assert whole.stats["rescued"]
    step, steps = pc.Continuation.step, []

    def failing(self, problem, state, key):
        steps.append(int(state.steps))
        if len(steps) == 4:
            raise StoppedError
        return step(self, problem, state, key)

    monkeypatch.setattr(pc.Continuation, "step", failing)
    with pytest.raises(StoppedError):
        pc.solve(problem, solver, checkpoint=tmp_path / "run")
    again = pc.solve(problem, solver, checkpoint=tmp_path / "run")
    assert steps[3] == steps[4] == 3
    assert bits(again) == bits(whole)


def finished(folder, **settings):
    settings = {"key": KEY, "throw": False} | settings
    return pc.solve(performative_prediction(0.5), Walk(LONG), checkpoint=folder, **settings)


def test_run_that_has_ended_comes_back_without_a_step(tmp_path, monkeypatch):
    first = finished(tmp_path / "run")
    monkeypatch.setattr(Walk, "init", None)
    monkeypatch.setattr(Walk, "finish", None)
    again = finished(tmp_path / "run")
    assert bits(again) == bits(first)
    assert isinstance(again.history, np.memmap) and not again.history.flags.writeable
    with pytest.raises(pc.SolveError):
        finished(tmp_path / "run", throw=True)
    np.testing.assert_array_equal(np.load(tmp_path / "run/history.npy"), first.history)


def test_folder_of_another_run_is_refused_and_left_alone(tmp_path):
    folder = tmp_path / "run"
    finished(folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    others = {
        "key": {"key": jax.random.key(6)},
        "every": {"every": 2},
        "record": {"record": jnp.sum},
        "start": {"M0": np.ones((1, 1, 1))},
        "steps": {"max_steps": 5},
    }
    for part, settings in others.items():
        assert_refused(lambda settings=settings: finished(folder, **settings), "checkpoint", f"of another {part}")
    other = performative_prediction(0.5 + 1e-12)
    assert_refused(lambda: pc.solve(other, Walk(LONG), key=KEY, checkpoint=folder), "checkpoint", "another problem")
    other = Walk(LONG, last=LONG - 1)
    solve = lambda: pc.solve(performative_prediction(0.5), other, key=KEY, checkpoint=folder)  # noqa: E731
    assert_refused(solve, "checkpoint", "another solver")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_folder_that_is_none_of_ours_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("a year of work")
    assert_refused(lambda: finished(tmp_path), "checkpoint", "thesis.txt")
    assert_refused(lambda: finished(tmp_path / "thesis.txt"), "checkpoint", "a file")
    assert_refused(lambda: finished(3), "checkpoint", "int")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_second_run_in_the_same_folder_is_refused_while_the_first_goes_on(tmp_path):
    with locked("checkpoint", tmp_path):
        assert_refused(lambda: finished(tmp_path), "checkpoint", "process")
    finished(tmp_path)


def test_run_cannot_be_kept_inside_of_a_trace(tmp_path):
    def run(key):
        return pc.solve(performative_prediction(0.5), Walk(3), key=key, checkpoint=tmp_path).M

    assert_refused(lambda: jax.jit(run)(KEY), "checkpoint", "jit")


def half(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def turned(path, place):
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(bytes(content))


def other_json(path):
    path.write_text(json.dumps({"format": "theirs"}))


DAMAGE = {
    "half a state": (lambda f: half(f / "state.npz"), "state.npz"),
    "a bit of the state turned": (lambda f: turned(f / "state.npz", -200), "state.npz"),
    "an empty state": (lambda f: (f / "state.npz").write_bytes(b""), "state.npz"),
    "the state of another run": (lambda f: shutil.copy(f.parent / "other/state.npz", f), "another run"),
    "half a history": (lambda f: half(f / "history.npy"), "history.npy"),
    "no history": (lambda f: (f / "history.npy").unlink(), "history.npy"),
    "a bit of the history turned": (lambda f: turned(f / "history.npy", 1000), "history.npy"),
    "another history": (lambda f: np.save(f / "history.npy", np.zeros(3)), "history.npy"),
    "another run.json": (lambda f: other_json(f / "run.json"), "run.json"),
    "half of run.json": (lambda f: half(f / "run.json"), "run.json"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damaged_folder_is_refused(tmp_path, case):
    for name, key in (("run", KEY), ("other", jax.random.key(6))):
        with pytest.raises(StoppedError):
            finished(tmp_path / name, key=key, progress=stop_at(2))
    damage, word = DAMAGE[case]
    damage(tmp_path / "run")
    assert_refused(lambda: finished(tmp_path / "run"), "checkpoint", word)


def test_answer_that_is_damaged_is_refused(tmp_path):
    finished(tmp_path / "run")
    kept = (tmp_path / "run/solution.npz").read_bytes()
    half(tmp_path / "run/solution.npz")
    assert_refused(lambda: finished(tmp_path / "run"), "checkpoint", "solution.npz")
    (tmp_path / "run/solution.npz").write_bytes(kept)
    half(tmp_path / "run/history.npy")
    assert_refused(lambda: finished(tmp_path / "run"), "checkpoint", "history.npy")


def test_run_begun_with_other_versions_is_not_continued_but_its_answer_is_read(tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(StoppedError):
        finished(folder, progress=stop_at(1))
    content = json.loads((folder / "run.json").read_text())
    content["versions"]["jaxlib"] = "0.0.1"
    (folder / "run.json").write_text(json.dumps(content))
    assert_refused(lambda: finished(folder), "checkpoint", "jaxlib 0.0.1")
    content["versions"] = run_folder._versions()
    (folder / "run.json").write_text(json.dumps(content))
    first = finished(folder)
    content["versions"] = {}
    (folder / "run.json").write_text(json.dumps(content))
    assert bits(finished(folder)) == bits(first)


def test_full_disk_says_which_file_and_the_run_goes_on_once_there_is_room(tmp_path):
    folder, whole = tmp_path / "run", finished(tmp_path / "whole")
    with pytest.raises(StoppedError):
        finished(folder, progress=stop_at(1))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((folder / "history.npy").stat().st_size + 100, hard))
    try:
        with pytest.raises(OSError, match=r"history\.npy"):
            finished(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert bits(finished(folder)) == bits(whole)


def test_what_killed_writers_leave_is_swept_away(tmp_path):
    with pytest.raises(StoppedError):
        finished(tmp_path / "run", progress=stop_at(1))
    (tmp_path / "run/.state.abc.npz").write_bytes(b"half a st")
    finished(tmp_path / "run")
    assert not list((tmp_path / "run").glob(".*"))
