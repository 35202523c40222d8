"""Finitely many matrices with probabilities that depend on the policy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.sets import LiftedSet
from tests.contracts.perturbation import PerturbationContract
from tests.oracles.enumeration import enumerate_cost
from tests.tools import assert_close, assert_refused, normal

VALUES = 0.5 * normal(1, 3, 3, 3)
VARYING = 0.5 * normal(2, 3, 2, 3, 5)


def affine(seed: int, *lead: int, count: int) -> pc.Affine:
    """Probabilities near the uniform ones whose slopes sum to zero, valid for ‖M‖_F ≤ 1.5."""
    slope = normal(seed, *lead, count, 2, 2, 3)
    slope = slope - jnp.mean(slope, axis=-4, keepdims=True)
    largest = jnp.max(jnp.sqrt(jnp.sum(slope**2, axis=(-3, -2, -1))))
    return pc.Affine(jnp.full((*lead, count), 1 / count), 0.6 / count * slope / largest)


class TestAffineProbabilities(PerturbationContract):
    def perturbation(self):
        return pc.FinitePerturbation(VALUES, affine(3, 3, count=3))


class TestTimeVaryingValuesOnStateAndInput(PerturbationContract):
    def perturbation(self):
        return pc.FinitePerturbation(VARYING, affine(4, count=2))


class TestFixedProbabilities(PerturbationContract):
    def perturbation(self):
        return pc.FinitePerturbation(VALUES, [0.2, 0.0, 0.8])


class TestSoftmaxOfThePolicy(PerturbationContract):
    knows = ("mean", "covariance", "bound")

    def perturbation(self):
        return pc.FinitePerturbation(VALUES, pc.Function(lambda M, p: jax.nn.softmax(p * M[0, 0]), 2.0))


def test_finite_moments_match_the_definition():
    law, M = pc.FinitePerturbation(VALUES, affine(3, 3, count=3)), 0.3 * normal(5, 2, 2, 3)
    p, X, V = np.asarray(affine(3, 3, count=3)(M)), np.asarray(normal(6, 3, 3)), np.asarray(VALUES)
    for t in range(3):
        mean = sum(p[t, j] * V[j] for j in range(3))
        assert_close(law.mean(M, 3)[t], mean)
        spread = sum(p[t, j] * (V[j] - mean) @ X @ (V[j] - mean).T for j in range(3))
        assert_close(law.covariance(M, 3).apply(jnp.asarray(X))[t], spread)


def test_finite_frequencies_match_the_probabilities():
    law, M = pc.FinitePerturbation(VALUES, affine(3, 3, count=3)), 0.3 * normal(5, 2, 2, 3)
    keys = jax.random.split(jax.random.key(1), 40_000)
    indices = np.asarray(jax.vmap(lambda key: law.sample(key, M, 3).indices)(keys))
    p = np.asarray(affine(3, 3, count=3)(M))
    for j in range(3):
        assert np.all(np.abs((indices == j).mean(axis=0) - p[:, j]) <= 5 * np.sqrt(p[:, j] / len(keys)))


def test_values_of_probability_zero_are_never_drawn():
    law = pc.FinitePerturbation(VALUES, [0.0, 1.0, 0.0])
    keys = jax.random.split(jax.random.key(1), 1000)
    indices = jax.vmap(lambda key: law.sample(key, normal(5, 2, 2, 3), 3).indices)(keys)
    assert bool(jnp.all(indices == 1))


def test_sensitivity_of_two_values_is_the_wasserstein_distance():
    """Between two atoms W₁ = |dp| times their distance, largest along the slope."""
    slope = np.asarray(normal(7, 2, 2, 3))
    law = pc.FinitePerturbation(VALUES[:2], pc.Affine([0.5, 0.5], np.stack([slope, -slope])))
    ball = LiftedSet(pc.FrobeniusBall(0.1), pc.FullStructure(), (2, 2, 3))
    expected = np.linalg.norm(slope) * np.linalg.norm(VALUES[0] - VALUES[1], 2)
    assert_close(law.sensitivity(ball, 3), np.full(3, expected))


def test_expected_cost_and_gradient_match_enumeration_for_probabilities_that_react():
    T, M, deployed = 4, 0.3 * normal(8, 1, 2, 2), 0.4 * normal(9, 1, 2, 2)
    values, atoms = 0.4 * normal(10, 2, 2, 4), np.array([[1.0, 0.5], [-1.0, 0.2]])
    probabilities = pc.Function(lambda M: jax.nn.softmax(jnp.stack([jnp.sum(M), 0.0])))
    A, B = 0.5 * normal(11, 2, 2), normal(12, 2, 2)
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=T,
        noise=pc.Empirical(atoms),
        cost=pc.QuadraticCost(np.eye(2), np.eye(2)),
        perturbation=pc.FinitePerturbation(values, probabilities),
        initial_state=[1.0, -1.0],
    )
    p, half = np.asarray(probabilities(deployed)), np.array([0.5, 0.5])
    expected = enumerate_cost(
        A=np.broadcast_to(A, (T, 2, 2)),
        B=np.broadcast_to(B, (T, 2, 2)),
        K=np.zeros((T + 1, 2, 2)),
        Q=np.broadcast_to(np.eye(2), (T + 1, 2, 2)),
        R=np.broadcast_to(np.eye(2), (T + 1, 2, 2)),
        M=M,
        noise=[(atoms, half)] * T,
        perturbations=[(np.asarray(values), p / p.sum())] * T,
        initial=(np.array([[1.0, -1.0]]), np.ones(1)),
    )
    assert_close(pc.expected_cost(problem, M, deployed=deployed), expected[0])
    assert_close(pc.expected_gradient(problem, M, deployed=deployed), expected[1])


def test_policy_that_leaves_the_probabilities_gives_no_finite_answer():
    law = pc.FinitePerturbation(VALUES, lambda M: jnp.asarray([1.0, 0.0, 0.0]) + jnp.sum(M))
    M = jnp.ones((2, 2, 3))
    assert bool(jnp.all(jnp.isfinite(law.mean(0 * M, 3)))) and bool(jnp.all(jnp.isnan(law.mean(M, 3))))
    assert bool(jnp.all(jnp.isnan(law.sample(jax.random.key(0), M, 3).dense())))


def check(values=VALUES, probabilities=(0.2, 0.3, 0.5)):
    pc.FinitePerturbation(values, probabilities).check((2, 2, 3), 3)


REFUSED = {
    "one matrix": (lambda: pc.FinitePerturbation(np.eye(3), [1.0]), "values", "[V]"),
    "sum": (lambda: pc.FinitePerturbation(VALUES, [0.5, 0.5, 0.5]), "probabilities", "sum one"),
    "negative": (lambda: pc.FinitePerturbation(VALUES, [1.5, -0.5, 0.0]), "probabilities", "-0.5"),
    "number": (lambda: pc.FinitePerturbation(VALUES, 1.0), "probabilities", "sum one"),
    "size of the state": (lambda: check(values=normal(1, 3, 2, 2)), "values", "(3, 2, 2)"),
    "time axis": (lambda: check(values=normal(1, 4, 3, 3, 3)), "values", "(4, 3, 3, 3)", "vary in time"),
    "map shape": (lambda: check(probabilities=lambda M: M[0]), "probabilities", "(2, 3)", "(3,)"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_finite_perturbation_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
