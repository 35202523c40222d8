"""Matrices that are drawn again each time, against the same matrices held."""

import subprocess
import sys
import textwrap
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.rollout import run_path, sample_path
from perfcontrol.perturbations import DenseDraws, redrawn
from tests.contracts.perturbation import PerturbationContract
from tests.tools import assert_close, normal

MEAN = pc.Affine(0.3 * normal(4, 3, 3, 3), 0.1 * normal(5, 3, 3, 3, 2, 2, 3))
SMALL = 40  # bytes: what the laws below draw is more


class TestDrawnAgain(PerturbationContract):
    knows = ("mean", "covariance")

    @pytest.fixture(autouse=True)
    def nothing_is_held(self, monkeypatch):
        monkeypatch.setattr(redrawn, "HELD", SMALL)

    def perturbation(self):
        return pc.DensePerturbation(pc.Affine([0.5, 0.3, 0.4], 0.1 * normal(1, 3, 2, 2, 3)), MEAN, law="rademacher")


LAWS = {
    "entries": pc.DensePerturbation(0.2, law="uniform", on_input=True),
    "of own scale, with a mean": pc.DensePerturbation(0.1 * np.abs(normal(2, 5, 3, 3)), 0.1 * normal(3, 3, 3)),
    "sphere": pc.DensePerturbation(0.2 * np.ones((3, 3)), 0.1 * normal(4, 5, 3, 3), law="sphere"),
    "random vector": pc.DensePerturbation(
        pc.Affine(0.2 * np.ones(5), np.ones((5, 1, 2, 3))), law=pc.Linear(pc.Uniform(-1, 1), normal(5, 9, 9), 0.1)
    ),
}


def problem_with(law):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.4 * normal(11, 3, 3), normal(12, 3, 2)),
        horizon=5,
        gain=0.1 * normal(13, 2, 3),
        noise=pc.Gaussian(np.zeros(3), np.eye(3)),
        cost=pc.QuadraticCost(np.eye(3), np.eye(2)),
        perturbation=law,
    )


@eqx.filter_jit
def _paths(problem, M, key):
    """A path and its gradient as they are, and with the matrices of the same draws held."""
    path = sample_path(problem, M, M, key)
    held = run_path(problem, M, path.x[0], path.w, DenseDraws(path.draws.dense()))
    return path, pc.path_gradient(problem, path), held, pc.path_gradient(problem, held)


@pytest.mark.float32
@pytest.mark.parametrize("name", LAWS)
def test_paths_and_gradients_are_those_of_the_same_matrices_held(name, monkeypatch):
    monkeypatch.setattr(redrawn, "HELD", SMALL)
    problem = problem_with(LAWS[name])
    path, gradient, held, reference = _paths(problem, 0.3 * normal(14, 1, 2, 3), pc.fast_key(1))
    assert isinstance(path.draws, redrawn.RedrawnDraws) and float(jnp.max(jnp.abs(path.draws.dense()))) > 0.01
    assert_close(path.x, held.x, 1e-13)
    assert_close(gradient, reference, 1e-13)


def test_sampled_gradients_are_those_of_the_simulated_paths(monkeypatch):
    """What `simulate` hands out can be drawn again, path by path, and the first paths stay as they are."""
    monkeypatch.setattr(redrawn, "HELD", SMALL)
    problem, M, key = problem_with(LAWS["sphere"]), 0.3 * normal(15, 1, 2, 3), jax.random.key(2)
    paths = pc.simulate(problem, M, key=key, samples=9)
    assert isinstance(paths.draws, redrawn.RedrawnDraws)
    assert_close(pc.path_gradient(problem, paths), pc.sample_gradient(problem, M, key=key, samples=9), 1e-13)
    assert_close(pc.simulate(problem, M, key=key, samples=2).x, paths.x[:2], 1e-13)


def test_only_what_is_large_is_drawn_again():
    def drawn(size):
        M = jnp.zeros((1, size, size))
        return eqx.filter_eval_shape(pc.DensePerturbation(0.1).sample, jax.random.key(0), M, 1000)

    assert isinstance(drawn(20), DenseDraws)
    assert isinstance(drawn(200), redrawn.RedrawnDraws)  # 160 MB even in float32


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system does not say how much a process held")
@pytest.mark.parametrize(
    "call", ["pc.sample_gradient(problem, M, key=key, samples=9)", "pc.solve(problem, pc.RSGD(2, 1e-9), M, key=key)"]
)
def test_hundred_thousand_steps_of_twenty_states_fit_into_six_hundred_mebibytes(call):
    """The matrices of one path alone are 320 MB, and there are nine paths."""
    program = f"""
        import numpy as np
        import perfcontrol as pc

        problem = pc.PerformativeProblem(
            system=pc.LinearSystem(0.9 * np.eye(20), np.eye(20)),
            horizon=100_000,
            noise=pc.Gaussian(np.zeros(20), np.eye(20)),
            cost=pc.QuadraticCost(np.eye(20), np.eye(20)),
            perturbation=pc.DensePerturbation(pc.Norm(0.01, 0.001)),
        )
        M, key = 0.01 * np.ones((1, 20, 20)), pc.fast_key(0)
        assert np.all(np.isfinite(getattr(answer := {call}, "M", answer)))
        print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
    """  # not by getrusage, which counts what the process that starts this one has held
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=True)
    assert int(done.stdout) * 1024 < 600 * 2**20
