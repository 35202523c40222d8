"""The state in a file: bit for bit in another process, whole or not at all, refused where it belongs to another."""

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import perfcontrol as pc
from perfcontrol._fingerprint import fingerprint
from tests.online.plants import drawn, run_episode
from tests.online.test_gate import OFF, volatile
from tests.solvers.problems import drifting
from tests.tools import assert_refused

key = jax.random.key(8)
GATE = pc.online.Gate(**OFF | {"cost": 1.5})


def controller(problem=None, gate=GATE, **settings):
    problem = drifting() if problem is None else problem
    return pc.online.Controller(
        problem, pc.RSGD(**({"steps": 20, "step_size": 0.02, "batch": 2} | settings)), gate=gate
    )


def learn(c, state, episodes):
    for _ in range(episodes):
        draws = drawn(c.problem, state.deployed, jax.random.fold_in(key, int(state.episode)))
        state = run_episode(c, state, c.problem, draws)
    return state


def begun(c, episodes=3):
    """After some episodes, and two steps of the next."""
    state = learn(c, c.init(), episodes)
    for _ in range(2):
        x = np.asarray(state.progress.x)
        state = c.observe(state, x, c.act(state, x), 0.5 * x + 0.1, np.eye(3))
    return state


def bits(state):
    return [(np.asarray(leaf).dtype.str, np.asarray(leaf).tobytes()) for leaf in jax.tree.leaves(state)]


def finished(state, c):
    """The rest of the episode at rest, and one more."""
    while state.progress.t < c.problem.horizon:
        x = np.asarray(state.progress.x)
        state = c.observe(state, x, c.act(state, x), 0.5 * x, 0.4 * np.eye(3))
    return learn(c, c.end_episode(state), 1)


@pytest.mark.parametrize(
    "settings", [{}, {"transform": optax.scale_by_adam(), "schedule": pc.Lazy(2)}], ids=["plain", "adam"]
)
def test_state_comes_back_bit_for_bit_and_goes_on_alike(tmp_path, settings):
    c = controller(**settings)
    state = begun(c)
    c.save(state, tmp_path / "plant.npz")
    again = controller(**settings).restore(tmp_path / "plant.npz")
    assert bits(again) == bits(state)
    assert (again.log, again.limits) == (state.log, state.limits) and len(state.log) == 3
    assert jax.tree.structure(again) == jax.tree.structure(state)
    assert bits(finished(again, c)) == bits(finished(state, c))
    assert [path.name for path in tmp_path.iterdir()] == ["plant.npz"]


ELSEWHERE = """
import sys, pathlib
from tests.online.test_files import controller, finished
c = controller()
c.save(finished(c.restore(sys.argv[1]), c), sys.argv[2])
"""


def test_state_goes_on_in_another_process_as_it_would_have_here(tmp_path):
    c = controller()
    state = begun(c)
    c.save(state, tmp_path / "here.npz")
    arguments = [
        sys.executable,
        "-c",
        "import tests.conftest\n" + ELSEWHERE,
        tmp_path / "here.npz",
        tmp_path / "there.npz",
    ]
    done = subprocess.run(arguments, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    there = c.restore(tmp_path / "there.npz")
    here = finished(state, c)
    assert bits(there) == bits(here) and there.log == here.log


def test_file_of_another_problem_solver_gate_or_precision_is_refused(tmp_path):
    c, path = controller(), tmp_path / "plant.npz"
    c.save(c.init(), path)
    other = eqx.tree_at(lambda p: p.perturbation.scale.params["high"], drifting(), jnp.asarray(0.1 + 1e-12))
    assert_refused(lambda: controller(other).restore(path), "path", "another problem")
    assert_refused(lambda: controller(step_size=0.03).restore(path), "path", "another solver")
    assert_refused(lambda: controller(gate=False).restore(path), "path", "another gate")
    assert_refused(lambda: controller(volatile()).restore(path), "path", "another problem")


def rewritten(path, change):
    """The file with its arrays changed."""
    with np.load(path) as file:
        arrays = dict(file)
    change(arrays)
    np.savez(path, **arrays)


def header(change):
    def apply(arrays):
        content = json.loads(arrays["header.json"].tobytes())
        change(content)
        arrays["header.json"] = np.frombuffer(json.dumps(content).encode(), np.uint8)

    return apply


BROKEN = {
    "not finite": (lambda a: a.update(deployed=a["deployed"] * np.nan), "not finite"),
    "infinite": (lambda a: a.update({"progress.x": a["progress.x"] + np.inf}), "progress.x"),
    "single precision": (lambda a: a.update(deployed=a["deployed"].astype(np.float32)), "float32"),
    "another shape": (lambda a: a.update(deployed=a["deployed"][:1]), "(1, 2, 3)"),
    "an array missing": (lambda a: a.pop("progress.t"), "no progress.t"),
    "an array too many": (lambda a: a.update(more=np.zeros(2)), "more arrays"),
    "no header": (lambda a: a.pop("header.json"), "KeyError"),
    "another format": (header(lambda h: h.update(format="2")), "KeyError"),
    "a header of lists": (header(lambda h: h.update(owner=[])), "header"),
    "limits of another kind": (header(lambda h: h.update(limits={"speed": 1.0})), "header"),
    "a log of another kind": (header(lambda h: h.update(log=[[1]])), "header"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_file_that_is_not_as_it_was_written_is_refused(tmp_path, case):
    c, path = controller(gate=False), tmp_path / "plant.npz"
    c.save(c.init(), path)
    change, word = BROKEN[case]
    rewritten(path, change)
    assert_refused(lambda: c.restore(path), "path", word, "save")


def test_what_is_no_such_file_is_refused(tmp_path):
    c, path = controller(gate=False), tmp_path / "plant.npz"
    assert_refused(lambda: c.restore(path), "path", "does not exist")
    assert_refused(lambda: c.restore(3), "path", "int")
    assert_refused(lambda: c.save(c.init(), None), "path", "NoneType")
    assert_refused(lambda: c.save(None, path), "state", "controller.init()")
    c.save(c.init(), path)
    whole = path.read_bytes()
    for content in (b"", b"text", whole[: len(whole) // 2], whole[:-30]):
        path.write_bytes(content)
        assert_refused(lambda: c.restore(path), "path", "Restore an earlier file")
    np.savez(path, a=np.array([{}], dtype=object), allow_pickle=True)
    assert_refused(lambda: c.restore(path), "path", "ValueError")
    assert_refused(lambda: c.restore(tmp_path), "path", "Error")


def test_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    c, path = controller(gate=False), tmp_path / "plant.npz"
    first = c.init()
    c.save(first, path)
    whole = path.read_bytes()
    broken = eqx.tree_at(lambda s: s.deployed, first, first.deployed + np.nan)
    assert_refused(lambda: c.save(broken, path), "state", "deployed", "not finite")

    def full(*_):
        raise OSError(28, "No space left on device")

    for function in ("fsync", "replace"):
        with monkeypatch.context() as patched:
            patched.setattr(os, function, full)
            with pytest.raises(OSError, match="No space"):
                c.save(first, path)
        assert path.read_bytes() == whole and [p.name for p in tmp_path.iterdir()] == ["plant.npz"]


def test_saved_file_is_on_the_disk_before_it_takes_its_place_and_its_folder_after(tmp_path, monkeypatch):
    c, path = controller(gate=False), tmp_path / "plant.npz"
    done, fsync, replace = [], os.fsync, os.replace

    def record(handle):
        done.append(os.fstat(handle).st_ino)
        fsync(handle)

    monkeypatch.setattr(os, "fsync", record)
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("replaced"), replace(*paths)))
    c.save(c.init(), path)
    assert done == [path.stat().st_ino, "replaced", tmp_path.stat().st_ino]


def scaled(factor):
    return lambda M: factor * jnp.sum(M**2)[None]


@functools.partial
def cut(M, low=0.1):
    return jnp.maximum(M, low)


def test_fingerprint_tells_numbers_closures_and_names_apart_but_not_where_things_lie():
    same = [lambda: scaled(2.0), drifting, lambda: pc.RSGD(3, 0.1), lambda: cut, lambda: np.float64(1.0)]
    marks = [fingerprint(make()) for make in same]
    assert marks == [fingerprint(make()) for make in same] and len(set(marks)) == len(marks)
    assert fingerprint(scaled(2.0)) != fingerprint(scaled(3.0))
    assert fingerprint(functools.partial(cut.func, low=0.2)) != fingerprint(functools.partial(cut.func, low=0.3))
    assert fingerprint(jnp.zeros(2)) != fingerprint(jnp.zeros((2, 1))) != fingerprint(jnp.zeros((1, 2)))
    assert fingerprint([1, [2]]) != fingerprint([1, 2]) != fingerprint([1, 2.0])
    assert fingerprint(jax.random.key(1)) != fingerprint(jax.random.key(2))
    assert fingerprint(pc.RSGD(3, 0.1, transform=optax.scale(2.0))) != fingerprint(
        pc.RSGD(3, 0.1, transform=optax.scale(3.0))
    )
    loop = []
    loop.append(loop)
    assert fingerprint(loop)
