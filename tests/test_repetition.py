"""What is the same again: bits in another process on the same machine, 1e-12 under another batching."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import perfcontrol as pc
from tests.solvers.problems import drifting
from tests.tools import assert_close

ROOT = Path(__file__).parents[1]
KEYS = jax.random.split(jax.random.key(3), 5)
PROGRAM = """
import sys, json, hashlib, jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
import numpy as np, perfcontrol as pc
pc.cache(sys.argv[1])
from tests.test_repetition import answers
digest = lambda tree: hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree))).hexdigest()
print(json.dumps({name: digest(answer()) for name, answer in answers().items()}))
"""


def answers():
    """Calls that draw, that are exact, that iterate, and that spread over devices."""
    problem, key = drifting(), pc.fast_key(5)
    M = np.full(problem.policy_shape, 0.05)
    return {
        "simulate": lambda: pc.simulate(problem, M, key=key, samples=30),
        "estimate": lambda: pc.estimate_cost(problem, M, key=key, samples=300),
        "gradient": lambda: pc.sample_gradient(problem, M, key=jax.random.key(1), samples=30),
        "exact": lambda: (pc.expected_cost(problem, M), pc.expected_gradient(problem, M, total=True)),
        "stable": lambda: pc.solve(problem, pc.StablePoint()),
        "descent": lambda: pc.solve(problem, pc.RSGD(300, 1e-3, average=True), key=key),
        "many": lambda: pc.solve_many(problem, pc.RSGD(100, 1e-3), keys=jax.random.split(key, 10)),
    }


def process(folder):
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))}
    command = [sys.executable, "-c", PROGRAM, str(folder)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
def test_another_process_gives_the_same_bits_compiled_anew_or_found_on_disk(tmp_path):
    first, found, anew = process(tmp_path / "kept"), process(tmp_path / "kept"), process(tmp_path / "other")
    assert first == found == anew and len(set(first.values())) == len(answers())


def test_paths_costs_and_gradients_under_vmap_are_those_of_one_key_after_another():
    problem, M = drifting(), np.full((2, 2, 3), 0.05)
    calls = {
        "paths": lambda key: pc.simulate(problem, M, key=key, samples=3).x,
        "cost": lambda key: pc.estimate_cost(problem, M, key=key, samples=20).mean,
        "gradient": lambda key: pc.sample_gradient(problem, M, key=key, samples=3),
    }
    for call in calls.values():
        assert_close(jax.vmap(call)(KEYS), np.stack([call(key) for key in KEYS]), 1e-12)


def test_the_first_samples_do_not_depend_on_how_many_are_drawn():
    problem, M = drifting(), np.full((2, 2, 3), 0.05)
    few, many = (pc.simulate(problem, M, key=KEYS[0], samples=samples).x for samples in (7, 40))
    assert_close(many[:7], few, 1e-12)
