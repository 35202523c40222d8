"""Killed at any moment: nothing that was written is lost, and the run ends with the bits of one that was left alone."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
KILLS = 50

RUN = """
import os, sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 1)
import perfcontrol as pc
from perfcontrol.solvers import checkpoint
from tests.solvers.problems import drifting
checkpoint.PAUSE = 1
key = jax.random.key(4)
if sys.argv[1] == "one":
    solver = pc.RSGD(40_000, pc.PowerStep(0.002, 0.6), average=True)
    pc.solve(drifting(), solver, key=key, checkpoint=sys.argv[2], every=10)
else:
    pc.solve_many(drifting(), pc.RSGD(300, 0.002), keys=jax.random.split(key, 2000), checkpoint=sys.argv[2])
"""


def started(kind, folder, cache):
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(cache),  # its own: writers of it are killed, too
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    environment.pop("XLA_FLAGS", None)
    command = [sys.executable, "-W", "ignore", "-c", RUN, kind, folder]
    return subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)


def finished(process):
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors


def written(folder):
    """What counts as done: the steps of the state, or the blocks."""
    blocks = {path.name: path.read_bytes() for path in folder.glob("runs-*.npz")}
    state = folder / "state.npz"
    if not state.exists():
        return 0, blocks
    with np.load(state) as file:
        return json.loads(file["header.json"].tobytes())["done"], blocks


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["one", "many"])
def test_run_killed_at_fifty_random_moments_ends_with_the_same_bits(tmp_path, kind):
    cache, folder = tmp_path / "cache", tmp_path / "run"
    finished(started(kind, tmp_path / "whole", cache))
    began = time.monotonic()
    finished(started(kind, tmp_path / "again", cache))
    whole = time.monotonic() - began
    moments = np.random.default_rng(7)
    killed, done, blocks = 0, 0, {}
    while killed < KILLS:
        process = started(kind, folder, cache)
        # From before the folder is opened to after the run could have ended.
        try:
            process.wait(timeout=float(moments.uniform(0.2, 1.0)) * whole)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            killed += 1
        else:
            finished(process)
        now, kept = written(folder)
        assert now >= done, "steps that were saved are lost"
        assert blocks.items() <= kept.items(), "blocks that were saved are lost or changed"
        done, blocks = now, kept
        if (folder / "solution.npz").exists() or len(kept) == len(list((tmp_path / "whole").glob("runs-*.npz"))) > 0:
            compare(folder, tmp_path / "whole")  # the run has ended: kill the next one
            folder, done, blocks = tmp_path / f"run-{killed}", 0, {}
    finished(started(kind, folder, cache))
    compare(folder, tmp_path / "whole")


def compare(folder, whole):
    names = sorted(path.name for path in whole.iterdir() if path.name != "lock")
    assert sorted(path.name for path in folder.iterdir() if path.name != "lock") == names
    for name in names:
        assert (folder / name).read_bytes() == (whole / name).read_bytes(), name
