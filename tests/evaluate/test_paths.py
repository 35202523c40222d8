"""Many paths on several devices are those on one."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np

import perfcontrol as pc
from perfcontrol.evaluate.paths import LANES, devices_for
from tests.tools import assert_close

ROOT = Path(__file__).parents[2]
DEVICES = 3
WORK = f"""
import sys, jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", {DEVICES})
import numpy as np
from tests.evaluate import test_paths
np.savez(sys.argv[1], **test_paths.answers())
"""
SAMPLES = 8 * LANES + 5  # fills neither devices nor lanes


def answers():
    problem = pc.experiments.stock_market("random")
    M, key = problem.initial_policy(), pc.fast_key(3)
    paths = pc.simulate(problem, M, key=key, samples=SAMPLES)
    assert len(paths.x.devices()) == 1
    estimate = pc.estimate_cost(problem, M, key=key, samples=SAMPLES)
    arrays = {"x": paths.x, "cost": paths.cost, "draws": jax.vmap(lambda draws: draws.dense())(paths.draws)}
    arrays |= {"mean": estimate.mean, "error": estimate.standard_error}
    arrays["gradient"] = pc.sample_gradient(problem, M, key=key, samples=SAMPLES)
    assert devices_for(SAMPLES, M) == len(jax.devices())
    return jax.tree.map(np.asarray, arrays)


def test_many_paths_on_three_devices_are_those_on_one(tmp_path):
    path = tmp_path / "answers.npz"
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-c", WORK, path], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    with np.load(path) as spread:
        for name, expected in answers().items():
            assert spread[name].shape == expected.shape
            assert_close(spread[name], expected, 1e-12)


def test_one_device_works_where_numbers_are_traced_or_paths_are_few(monkeypatch):
    monkeypatch.setattr(jax, "local_devices", lambda: [None] * DEVICES)
    assert devices_for(DEVICES * LANES, np.ones(2)) == DEVICES
    assert devices_for(DEVICES * LANES - 1, np.ones(2)) == 1
    seen = []
    jax.jit(lambda x: seen.append(devices_for(100, x)) or x)(1.0)
    assert seen == [1]
