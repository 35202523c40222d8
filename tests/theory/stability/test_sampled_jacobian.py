"""Sampled Jacobians held as matrices and seen through probes."""

import jax
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory import hessian, reaction_jacobian
from perfcontrol.theory.stability.sampled_jacobian import sample_jacobians
from tests.theory.problems import random_problem
from tests.tools import assert_mean_is


@pytest.mark.slow
def test_products_with_probes_match_the_matrices():
    problem = random_problem(3, bounded=False, strength=0.2)
    M = pc.solve(problem, pc.StablePoint()).M
    basis = np.eye(M.size)
    (held, _), gradients = sample_jacobians(problem, M, basis, jax.random.key(0), 4000, held=True)
    (probed, _), same = sample_jacobians(problem, M, basis, jax.random.key(0), 4000, held=False)
    X = np.diag(np.arange(1.0, M.size + 1))
    for one, two in ((held.mean_square(X), probed.mean_square(X)), (held.adjoint(X), probed.adjoint(X))):
        assert np.linalg.norm(one - two) < 0.15 * np.linalg.norm(one)
    assert probed.values(X, X).mean() == pytest.approx(held.values(X, X).mean(), rel=0.15)
    drift = hessian(problem, M) + reaction_jacobian(problem, M, M)
    assert held.matrices.mean(axis=0) == pytest.approx(drift, abs=6 * held.matrices.std() / np.sqrt(2000) * 3)
    np.testing.assert_allclose(gradients, same, atol=1e-10 * np.abs(same).max())
    assert_mean_is(gradients, np.asarray(pc.expected_gradient(problem, M)).reshape(-1))
