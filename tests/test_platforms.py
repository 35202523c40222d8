"""Nothing assumes a CPU: what runs compiled is lowered for a GPU as well, though none need be there."""

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.adjoint import mean_path_gradient
from perfcontrol.evaluate.exact import exact_cost
from tests.solvers.problems import performative_prediction


def lowered_for_cuda(function, *arguments):
    arrays, others = eqx.partition(arguments, eqx.is_array)
    compiled = jax.jit(lambda arrays: function(*eqx.combine(arrays, others)))
    return jax.export.export(compiled, platforms=("cuda",))(arrays)


def one_step(problem, solver, key):
    solver = solver.on(problem, key)
    state = solver.step(problem, solver.init(problem, problem.initial_policy()), key)
    return state.M, solver.finish(problem, state, False)[1]


def dense(**options):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * jnp.eye(3), jnp.eye(3)),
        noise=pc.Gaussian(jnp.zeros(3), jnp.eye(3)),
        cost=pc.QuadraticCost(jnp.eye(3), jnp.eye(3)),
        perturbation=pc.DensePerturbation(pc.Norm(0.1, 0.1), law="gaussian"),
        **options,
    )


@pytest.mark.parametrize("key", [jax.random.key, pc.fast_key])
def test_sampled_gradients_are_lowered_for_a_gpu(key):
    for problem in (pc.experiments.stock_market("random"), dense(horizon=5)):
        M = problem.initial_policy()
        lowered = lowered_for_cuda(lambda p, M, key: mean_path_gradient(p, M, M, key, 3), problem, M, key(0))
        assert lowered.platforms == ("cuda",)


@pytest.mark.parametrize("problem", [lambda: dense(horizon=5), lambda: dense(horizon=jnp.inf)])
def test_exact_evaluation_and_best_responses_are_lowered_for_a_gpu(problem):
    problem = problem()
    M = problem.initial_policy()
    assert lowered_for_cuda(exact_cost, problem, M, M).platforms == ("cuda",)
    assert lowered_for_cuda(lambda p, M: (pc.residual(p, M), pc.best_response(p, M)), problem, M).platforms == ("cuda",)


@pytest.mark.parametrize("solver", [pc.RSGD(10, 0.1), pc.RRM(anderson=2), pc.StablePoint(), pc.Continuation()], ids=str)
@pytest.mark.parametrize("feasible_set", [pc.FrobeniusBall(1.0), pc.SpectralBall(1.0)], ids=str)
def test_solvers_are_lowered_for_a_gpu(solver, feasible_set):
    problem = performative_prediction(0.5, feasible_set=feasible_set)
    assert lowered_for_cuda(one_step, problem, solver, jax.random.key(0)).platforms == ("cuda",)
