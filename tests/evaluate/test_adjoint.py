"""The gradient along a path, and the noise recovered from one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.adjoint import mean_path_gradient
from perfcontrol.evaluate.rollout import run_path, sample_path
from tests.evaluate.cases import BUILDERS, SmoothCost, case, replaced
from tests.oracles.printed_gradient import printed_gradient
from tests.tools import assert_close, assert_mean_is, central_differences, relative_error

ON_STATE = [name for name in BUILDERS if name not in ("everything varies, performative B", "reweighted matrices")]


@eqx.filter_jit
def _path(problem, M, deployed, key):
    path = sample_path(problem, problem.structure.lift(M), problem.structure.lift(deployed), key)
    return path, pc.path_gradient(problem, path)


def path_and_gradient(problem, c, seed: int = 0):
    return _path(problem, c.M, c.deployed, jax.random.key(seed))


@eqx.filter_jit
def _cost(problem, M, path):
    moved = run_path(problem, problem.structure.lift(M), path.x[0], path.w, path.draws)
    return jnp.sum(problem.cost.path_cost(moved.x, moved.u))


@pytest.mark.float32
@pytest.mark.parametrize("name", ON_STATE)
def test_path_gradient_matches_the_printed_formula(name):
    c = case(name)
    path, gradient = path_and_gradient(c.problem, c)
    by_state, by_input = c.problem.cost.path_gradients(path.x, path.u)
    printed = printed_gradient(
        **c.system(),
        deltas=np.asarray(path.draws.dense()),
        x=np.asarray(path.x),
        w=np.asarray(path.w),
        M_shape=c.problem.lifted_shape,
        grad_x=np.asarray(by_state),
        grad_u=np.asarray(by_input),
    )
    assert_close(gradient, c.problem.structure.adjoint(jnp.asarray(printed)), 1e-12, 1e-4)


@pytest.mark.parametrize("name", BUILDERS)
def test_path_gradient_matches_central_differences(name):
    """Exact up to rounding: the cost of a path is quadratic in M."""
    c = case(name)
    path, gradient = path_and_gradient(c.problem, c, seed=1)
    differences = central_differences(lambda M: _cost(c.problem, jnp.asarray(M), path), c.M, step=0.1)
    assert relative_error(gradient, differences) < 1e-11


@pytest.mark.parametrize("name", ["everything varies", "everything varies, performative B"])
def test_path_gradient_matches_central_differences_when_the_cost_is_not_quadratic(name):
    c = case(name)
    problem = replaced(c.problem, cost=SmoothCost())
    path, gradient = path_and_gradient(problem, c, seed=2)
    differences = central_differences(lambda M: _cost(problem, jnp.asarray(M), path), c.M, step=1e-5)
    assert relative_error(gradient, differences) < 1e-8


@pytest.mark.parametrize("name", ["everything varies, performative B", "repeated block"])
def test_path_gradients_within_five_standard_errors_of_the_expected_gradient(name):
    c = case(name)

    @eqx.filter_jit
    def gradients(problem, keys):
        return jax.vmap(lambda key: mean_path_gradient(problem, c.M, c.deployed, key, 1))(keys)

    samples = gradients(c.problem, jax.random.split(jax.random.key(3), 3000))
    assert_mean_is(samples, pc.expected_gradient(c.problem, c.M, deployed=c.deployed))


def test_sample_gradient_is_the_mean_over_the_simulated_paths():
    c = case("zero means")
    key = jax.random.key(4)
    trajectories = pc.simulate(c.problem, c.M, deployed=c.deployed, key=key, samples=3)
    together = eqx.filter_jit(pc.path_gradient)(c.problem, trajectories)
    assert_close(pc.sample_gradient(c.problem, c.M, deployed=c.deployed, key=key, samples=3), together)
    mean_cost = jax.jit(lambda M: jnp.mean(jax.vmap(lambda path: _cost(c.problem, M, path))(trajectories)))
    assert_close(together, central_differences(lambda M: mean_cost(jnp.asarray(M)), c.M, step=0.1), 1e-10)


@pytest.mark.float32
@pytest.mark.parametrize("name", ON_STATE)
def test_recovered_noise_equals_the_noise_injected(name):
    c = case(name)
    path, _ = path_and_gradient(c.problem, c)
    A = jnp.asarray(c.system()["A"]) + path.draws.dense()
    assert_close(pc.recover_noise(c.problem, path.x, path.u, A), path.w, 1e-12, 1e-4)
