"""The local model against finite differences and the closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory import hessian, reaction_jacobian
from perfcontrol.theory.stability.local_model import local_model
from tests.theory.problems import random_problem


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_derivative_of_the_best_response_matches_finite_differences_where_the_ball_is_active(seed):
    problem = random_problem(seed, strength=0.5)
    problem = eqx.tree_at(lambda p: p.feasible_set.limit, problem, jnp.asarray(0.05))
    M = problem.initial_policy()
    for _ in range(60):
        M = pc.best_response(problem, M)
    assert float(jnp.linalg.norm(M)) == pytest.approx(0.05)
    model = local_model(problem, M)
    assert model.damping is not None and model.basis.shape[1] == M.size - 1
    for column, direction in zip(model.response_jacobian.T, model.basis.T, strict=True):
        V, step = jnp.asarray(direction.reshape(M.shape)), 1e-5
        central = (pc.best_response(problem, M + step * V) - pc.best_response(problem, M - step * V)) / (2 * step)
        np.testing.assert_allclose(column, model.basis.T @ np.asarray(central).reshape(-1), atol=1e-7)


def test_unconstrained_response_jacobian_is_minus_inverse_hessian_times_reaction():
    problem = random_problem(7, bounded=False, strength=0.2)
    M = pc.solve(problem, pc.StablePoint()).M
    H, E = hessian(problem, M), reaction_jacobian(problem, M, M)
    np.testing.assert_allclose(local_model(problem, M).response_jacobian, -np.linalg.solve(H, E), atol=1e-10)
    step, V = 1e-5, jax.random.normal(jax.random.key(0), M.shape)
    difference = pc.expected_gradient(problem, M, deployed=M + step * V) - pc.expected_gradient(
        problem, M, deployed=M - step * V
    )
    np.testing.assert_allclose(
        E @ np.asarray(V).reshape(-1), np.asarray(difference).reshape(-1) / (2 * step), rtol=1e-5, atol=1e-8
    )
