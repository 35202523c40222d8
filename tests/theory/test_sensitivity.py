"""Sensitivities by every method."""

import jax
import numpy as np
import pytest

import perfcontrol as pc
from tests.theory.problems import random_problem


def test_sensitivity_estimates_agree_for_one_direction():
    """Δ = σ(M) ζ D with one direction: ε = ‖slope‖ E|ζ| ‖D‖ by every method."""
    one = np.ones((1, 1))
    slope = np.array([[0.3, -0.4]]).reshape(1, 1, 1, 2)
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * np.eye(2), np.ones((2, 1))),
        horizon=2,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(np.eye(2), one),
        perturbation=pc.DirectionalPerturbation([2 * np.eye(2)], pc.Affine([1.0], slope)),
        feasible_set=pc.FrobeniusBall(1.0),
    )
    analytic = pc.estimate_sensitivity(problem, method="analytic")
    np.testing.assert_allclose(analytic.epsilon, [1.0, 1.0])
    coupling = pc.estimate_sensitivity(problem, key=jax.random.key(0), policies=2, samples=16)
    np.testing.assert_allclose(coupling.epsilon, [1.0, 1.0], rtol=1e-9)
    assert analytic.status == "proved" and coupling.status == "estimated"


def test_transport_estimate_matches_the_exact_distance_of_two_point_laws():
    pytest.importorskip("ot")
    problem = random_problem(0, "scalar", strength=0.5)
    key = jax.random.key(0)
    found = pc.estimate_sensitivity(problem, method="transport", key=key, policies=3, samples=400, distance=1.0)
    exact = pc.estimate_sensitivity(problem, method="analytic").epsilon
    assert np.all(found.epsilon <= exact * 1.5 + 0.1) and found.epsilon.max() > 0.3 * exact.max()


def test_transport_says_which_package_is_missing(monkeypatch):
    import importlib

    def refuse(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(pc.InputError, match="POT"):
        pc.estimate_sensitivity(random_problem(0, "scalar"), method="transport", key=jax.random.key(0))


def test_sensitivity_estimates_refuse_bad_input():
    problem = random_problem(0, "scalar")
    with pytest.raises(pc.InputError, match="method"):
        pc.estimate_sensitivity(problem, method="guess")
    with pytest.raises(pc.InputError, match="key"):
        pc.estimate_sensitivity(problem)
