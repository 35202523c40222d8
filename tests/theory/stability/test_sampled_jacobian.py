"""Sampled Jacobians held as matrices and seen through probes."""

import jax
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory.derivatives import hessian, reaction_jacobian
from perfcontrol.theory.stability.sampled_jacobian import JacobianSamples
from tests.theory.problems import random_problem


@pytest.mark.slow
def test_products_with_probes_match_the_matrices():
    problem = random_problem(3, bounded=False, strength=0.2)
    M = pc.solve(problem, pc.StablePoint()).M
    basis = np.eye(M.size)
    held = JacobianSamples(problem, M, basis, jax.random.key(0), 2000)
    probed = JacobianSamples(problem, M, basis, jax.random.key(0), 2000, matrices=False)
    X = np.diag(np.arange(1.0, M.size + 1))
    assert held.held is not None and probed.held is None
    for one, two in ((held.mean_square(X), probed.mean_square(X)), (held.adjoint(X), probed.adjoint(X))):
        assert np.linalg.norm(one - two) < 0.15 * np.linalg.norm(one)
    assert probed.values(X, X).mean() == pytest.approx(held.values(X, X).mean(), rel=0.15)
    drift = hessian(problem, M) + reaction_jacobian(problem, M, M)
    assert held.held.mean(axis=0) == pytest.approx(drift, abs=6 * held.held.std() / np.sqrt(2000) * 3)
