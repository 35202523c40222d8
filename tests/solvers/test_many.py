"""Many runs at once: each is what `pc.solve` makes of it, whatever the devices, processes and interruptions."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.solvers import blocks
from perfcontrol.solvers.axes import stack
from tests.solvers.problems import drifting, performative_prediction
from tests.solvers.test_checkpoint import StoppedError, bits, half, stop_at
from tests.solvers.test_solve import Walk
from tests.tools import assert_close, assert_refused

KEYS = jax.random.split(jax.random.key(2), 3)
PROBLEMS = [performative_prediction(sensitivity) for sensitivity in (0.2, 0.9)]
SOLVERS = [pc.RSGD(230, pc.InverseStep(phi1, 20.0)) for phi1 in (1.0, 2.0)]
ROOT = Path(__file__).parents[2]


def mean(M):
    return {"M": M, "mean": M.mean()}


def test_runs_whose_large_matrices_are_never_drawn_are_worked_on_together():
    n = 40
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * np.eye(n), np.eye(n)),
        horizon=3,
        noise=pc.Rademacher(np.ones(n)),
        cost=pc.QuadraticCost(np.eye(n), np.eye(n)),
        perturbation=pc.DensePerturbation(0.01, law="gaussian"),
    )
    assert blocks.lanes_of(problem, pc.RSGD(3, 0.1), 64) == 4
    assert blocks.lanes_of(problem, pc.RSGD(3, 0.1, gradient=pc.EstimatedDynamics()), 64) == 1


@pytest.mark.float32
def test_runs_equal_those_of_solve_for_every_problem_solver_and_key():
    every = 7
    many = pc.solve_many(PROBLEMS, SOLVERS, keys=KEYS, record=mean, every=every)
    assert many.M.shape == (2, 2, 3, 1, 1, 1) and many.history["mean"].shape == (2, 2, 3, 230 // every + 1)
    for i, j, k in np.ndindex(2, 2, 3):
        one = pc.solve(PROBLEMS[i], SOLVERS[j], key=KEYS[k], record=mean, every=every)
        alike = jax.tree.map(lambda leaf, place=(i, j, k): leaf[place], many)
        assert jax.tree.structure(alike) == jax.tree.structure(one)
        for ours, theirs in zip(jax.tree.leaves(alike), jax.tree.leaves(one), strict=True):
            assert_close(ours, theirs, 1e-12, 1e-5)


@pytest.mark.filterwarnings("ignore::perfcontrol.UnstableGainWarning")
def test_axes_are_those_given_as_many():
    solver, key = Walk(3), KEYS[0]
    stacked = stack("problems", [performative_prediction(0.1 * i) for i in range(4)], "")
    assert pc.solve_many(PROBLEMS[0], solver, keys=key).M.shape == (1, 1, 1)
    assert pc.solve_many(PROBLEMS[0], solver, keys=KEYS).M.shape == (3, 1, 1, 1)
    assert pc.solve_many(PROBLEMS[:1], [solver], keys=KEYS).M.shape == (1, 1, 3, 1, 1, 1)
    own = jax.random.split(key, (4, 1, 2))
    many = pc.solve_many(stacked, [solver] * 3, keys=own)
    assert many.M.shape == (4, 3, 2, 1, 1, 1)
    for i, j, k in np.ndindex(4, 3, 2):
        assert_close(many.M[i, j, k], pc.solve(PROBLEMS[0], solver, key=own[i, 0, k], throw=False).M)
    starts = np.arange(4.0).reshape(4, 1, 1, 1, 1)
    assert_close(pc.solve_many(stacked, solver, starts, keys=KEYS, max_steps=0).M, np.repeat(starts, 3, axis=1))


def test_stacked_problems_without_keys_reach_their_stable_points():
    rising = [0.2, 0.5, -3.0]
    shape = jnp.zeros((1, 1, 1, 1, 1))
    stacked = jax.vmap(lambda s: eqx.tree_at(lambda p: p.perturbation.mean_map.slope, PROBLEMS[0], s + shape))
    many = pc.solve_many(stacked(jnp.asarray(rising)), pc.StablePoint())
    assert_close(many.M[:, 0, 0, 0], 10 / (1 - np.array(rising)), 1e-10)
    assert many.history is None and np.all(many.result == pc.Result.success)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::perfcontrol.UnstableGainWarning")
def test_failed_run_is_rescued_as_by_solve():
    problem, solver = drifting(feasible_set=pc.FrobeniusBall(3.0)), pc.StablePoint(max_steps=1)
    one, many = pc.solve(problem, solver), pc.solve_many([problem], solver)
    assert one.stats["rescued"] and many.stats["rescued"][0] and np.all(many.result == pc.Result.success)
    assert_close(many.M[0], one.M, 1e-10)


def test_failures_are_part_of_the_answer_or_raise():
    solver = Walk(20, 7, pc.Result.diverged)
    many = pc.solve_many(PROBLEMS[0], solver, keys=KEYS)
    assert np.all(many.result == pc.Result.diverged) and np.all(many.steps == 7)
    with pytest.raises(pc.SolveError, match="3 of 3: The iterates grew"):
        pc.solve_many(PROBLEMS[0], solver, keys=KEYS, throw=True)


def test_blocks_cover_every_run_once_and_fill_little():
    for count in (1, 7, 8, 31, 33, 100, 1001):
        for together in (1, 3, 8):
            found = blocks.blocks_of(count, together)
            assert sorted(set(np.concatenate(found))) == list(range(count))
            assert len({len(block) for block in found}) == 1
            assert sum(len(block) for block in found) - count < together * len(found) * len(jax.local_devices())


def kept(folder, **settings):
    settings = {"keys": jax.random.split(jax.random.key(3), 70), "record": mean, "every": 7} | settings
    return pc.solve_many(PROBLEMS, Walk(120), checkpoint=folder, **settings)


def test_stopped_runs_go_on_with_the_blocks_that_are_left(tmp_path, monkeypatch):
    whole = kept(tmp_path / "whole")
    size = len(list((tmp_path / "whole").glob("runs-*.npz")))
    assert size >= 3
    with pytest.raises(StoppedError):
        kept(tmp_path / "run", progress=stop_at(3))
    left = len(list((tmp_path / "run").glob("runs-*.npz")))
    assert left == 1
    begun, run = [], blocks.Work.run
    monkeypatch.setattr(blocks.Work, "run", lambda *arguments: begun.append(1) or run(*arguments))
    again = kept(tmp_path / "run")
    assert len(begun) == size - left
    assert bits(again) == bits(whole) == bits(kept(tmp_path / "run"))
    assert len(begun) == size - left


def test_folder_of_other_runs_or_damaged_is_refused(tmp_path):
    kept(tmp_path)
    assert_refused(lambda: kept(tmp_path, every=6), "checkpoint", "another every")
    assert_refused(lambda: kept(tmp_path, keys=KEYS), "checkpoint", "another keys")
    half(sorted(tmp_path.glob("runs-*.npz"))[1])
    assert_refused(lambda: kept(tmp_path), "checkpoint", "runs-")


def test_wrong_arguments_are_refused():
    def refused(name, *words, problems=PROBLEMS, solver=SOLVERS, keys=KEYS, **settings):
        assert_refused(lambda: pc.solve_many(problems, solver, keys=keys, **settings), name, *words)

    refused("problems", "int", problems=3)
    refused("problems", "empty", problems=[])
    refused("problems", "place 1", problems=[PROBLEMS[0], drifting()])
    refused("solver", "place 1", solver=[pc.RSGD(10, 0.1), pc.RSGD(20, 0.1)])
    refused("solver", "place 1", solver=[pc.RSGD(10, 0.1), pc.StablePoint()])
    refused("solver", "int", solver=[3])
    refused("key", "None", keys=None)
    refused("keys", "int", keys=3)
    refused("keys", "(2, 3, 3)", keys=jax.random.split(KEYS[0], (2, 3, 3)))
    refused("keys", "at least one", keys=KEYS[:0])
    refused("M0", "(1, 1, 2)", M0=np.zeros((1, 1, 2)))
    ball = performative_prediction(0.5, feasible_set=pc.FrobeniusBall(1.0))
    refused("M0", "6 of 6", problems=ball, M0=np.full((1, 1, 1), 2.0))
    refused("every", every=0)
    refused("progress", progress=3)


WORKER = """
import sys, json, jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
jax.config.update("jax_enable_x64", True)
if len(sys.argv) > 3:
    jax.distributed.initialize(sys.argv[3], int(sys.argv[4]), int(sys.argv[5]))
import numpy as np, perfcontrol as pc
from tests.solvers import test_many as t
folder = sys.argv[6] if len(sys.argv) > 6 else None
keys = jax.random.split(jax.random.key(2), 11)
many = pc.solve_many(t.PROBLEMS, t.SOLVERS, keys=keys, record=t.mean, every=7, checkpoint=folder)
np.savez(sys.argv[2], M=many.M, history=many.history["M"], result=many.result._value)
"""


def work(*arguments):
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, "-c", WORKER, *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)


def answer_of(worker, path):
    _, errors = worker.communicate(timeout=300)
    assert worker.returncode == 0, errors
    with np.load(path) as file:
        return dict(file)


@pytest.fixture(scope="module")
def expected():
    keys = jax.random.split(jax.random.key(2), 11)
    many = pc.solve_many(PROBLEMS, SOLVERS, keys=keys, record=mean, every=7)
    return {"M": many.M, "history": many.history["M"], "result": many.result._value}


def test_eight_devices_give_what_one_gives(tmp_path, expected):
    answer = answer_of(work(8, tmp_path / "a.npz"), tmp_path / "a.npz")
    for name, value in expected.items():
        assert_close(answer[name], value, 1e-12)


@pytest.mark.slow
def test_two_processes_give_what_one_gives_and_share_a_folder(tmp_path, expected):
    written = {}
    for again in range(2):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free.getsockname()[1]}"
        paths = [tmp_path / f"{again}-{process}.npz" for process in range(2)]
        workers = [work(1, path, address, 2, process, tmp_path / "run") for process, path in enumerate(paths)]
        for worker, path in zip(workers, paths, strict=True):
            answer = answer_of(worker, path)
            for name, value in expected.items():
                assert_close(answer[name], value, 1e-12)
        blocks = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "run").glob("runs-*.npz")}
        written = written or blocks
        assert len(blocks) > 1 and blocks == written, "the second call writes nothing anew"
    assert json.loads((tmp_path / "run/run.json").read_text())["steps"] == 230


@pytest.mark.slow
def test_threads_that_use_all_devices_at_once_do_not_wait_for_one_another():
    """Four threads, ten calls each, on eight devices: all end, with the same bits."""
    code = """
import threading
import jax
jax.config.update("jax_num_cpu_devices", 8)
import numpy as np
import perfcontrol as pc
from tests.solvers.problems import performative_prediction

problems, keys = [performative_prediction(0.2), performative_prediction(0.9)], jax.random.split(pc.fast_key(0), 16)
answers = []

def work():
    for _ in range(10):
        answers.append(np.asarray(pc.solve_many(problems, pc.RSGD(120, 0.01), keys=keys).M))

threads = [threading.Thread(target=work) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(len(answers), len({answer.tobytes() for answer in answers}))
"""
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300, check=True
    )
    assert run.stdout.split() == ["40", "1"]
