"""Location and scale of dense random matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.sets import LiftedSet
from tests.contracts.perturbation import PerturbationContract
from tests.tools import assert_close, assert_refused, normal, random_psd

COMMON = pc.Affine([0.5, 0.3, 0.4], 0.1 * normal(1, 3, 2, 2, 3))
ENTRYWISE = pc.Affine(0.3 * normal(2, 3, 5), 0.1 * normal(3, 3, 5, 2, 2, 3))
MEAN = pc.Affine(0.3 * normal(4, 3, 3, 3), 0.1 * normal(5, 3, 3, 3, 2, 2, 3))


class TestUniformEntriesOfCommonScale(PerturbationContract):
    def perturbation(self):
        return pc.DensePerturbation(COMMON, MEAN)


class TestSphereOnStateAndInput(PerturbationContract):
    def perturbation(self):
        return pc.DensePerturbation(ENTRYWISE, 0.2 * normal(6, 3, 5), law="sphere", on_input=True)


class TestRademacherEntriesOfOwnScale(PerturbationContract):
    def perturbation(self):
        return pc.DensePerturbation(ENTRYWISE, law="rademacher", on_input=True)


class TestAnyBoundedLaw(PerturbationContract):
    """Correlated entries with a mean: the scale moves the mean of Δ as well."""

    def perturbation(self):
        law = pc.Linear(pc.Uniform(-np.ones(4), np.ones(4)), 0.4 * normal(7, 9, 4), 0.2 * normal(8, 9))
        return pc.DensePerturbation(COMMON, MEAN, law=law)


class TestUnboundedLawOfFixedScale(PerturbationContract):
    knows = ("mean", "covariance", "sensitivity")

    def perturbation(self):
        return pc.DensePerturbation(0.4, law=pc.Gaussian(np.zeros(9), 0.3 * random_psd(9, 9)))


class TestGaussianEntries(PerturbationContract):
    knows = ("mean", "covariance", "sensitivity")

    def perturbation(self):
        return pc.DensePerturbation(COMMON, MEAN, law="gaussian")


class TestFunctionOfThePolicy(PerturbationContract):
    knows = ("mean", "covariance")

    def perturbation(self):
        return pc.DensePerturbation(pc.Function(lambda M, p: p + jnp.sum(M**2), 0.1), law="truncated_gaussian")


def test_white_covariance_is_the_trace_for_a_common_scale():
    """E[(sZ) X (sZ)ᵀ] = s² tr(X) I for every law of uncorrelated entries of unit variance."""
    X, M = random_psd(1, 3), normal(2, 2, 2, 3)
    for law in ("sphere", "uniform", "rademacher", "truncated_gaussian"):
        covariance = pc.DensePerturbation(0.7, law=law).covariance(M, 2)
        assert_close(covariance.apply(X)[1], 0.49 * jnp.trace(X) * jnp.eye(3))


def test_dense_laws_agree_on_what_they_share():
    """Uncorrelated entries given by name and as a random vector have the same moments."""
    X, M = normal(1, 3, 3), 0.3 * normal(2, 2, 2, 3)
    by_name = pc.DensePerturbation(COMMON, MEAN, law="rademacher")
    as_vector = pc.DensePerturbation(COMMON, MEAN, law=pc.Rademacher(1.0))
    assert_close(as_vector.mean(M, 3), by_name.mean(M, 3))
    assert_close(as_vector.covariance(M, 3).apply(X), by_name.covariance(M, 3).apply(X))
    assert_close(as_vector.covariance(M, 3).adjoint(X), by_name.covariance(M, 3).adjoint(X))
    lifted = LiftedSet(pc.FrobeniusBall(1.0), pc.FullStructure(), (2, 2, 3))
    assert_close(as_vector.bound(lifted, 3), by_name.bound(lifted, 3))
    assert_close(as_vector.sensitivity(lifted, 3), by_name.sensitivity(lifted, 3))


def test_bound_of_rademacher_entries_is_attained_by_equal_signs():
    lifted = LiftedSet(pc.FrobeniusBall(1.0), pc.FullStructure(), (2, 2, 3))
    assert_close(pc.DensePerturbation(0.5, law="rademacher").bound(lifted, 2), np.full(2, 0.5 * 3))


@pytest.mark.parametrize("law", ["sphere", pc.Constant([1.0, -1.0, 1.0])], ids=["sphere", "vector"])
def test_sensitivity_of_one_row_is_the_wasserstein_distance(law):
    """A 1 x 3 matrix of constant norm √3 times a positive scale: W₁ = √3 |scale - scale'|, largest along the slope."""
    slope = normal(9, 1, 1, 2, 1)
    perturbation = pc.DensePerturbation(pc.Affine([9.0], slope), law=law, on_input=True)
    lifted = LiftedSet(pc.FrobeniusBall(1.0), pc.FullStructure(), (1, 2, 1))
    assert_close(perturbation.sensitivity(lifted, 1), [np.sqrt(3) * np.linalg.norm(slope)])


def test_sensitivity_of_the_mean_is_its_largest_slope():
    """Nothing is random: W₁ = ‖mean - mean'‖; here one entry moves by one policy entry, another by another, less."""
    slope = np.zeros((3, 3, 2, 2, 3))
    slope[0, 0, 0, 0, 0], slope[1, 2, 1, 1, 2] = 0.7, 0.3
    law = pc.DensePerturbation(0.0, pc.Affine(np.zeros((3, 3)), slope))
    lifted = LiftedSet(pc.FrobeniusBall(1.0), pc.FullStructure(), (2, 2, 3))
    assert_close(law.sensitivity(lifted, 2), [0.7, 0.7])


def test_sphere_draws_have_the_radius_they_claim():
    law = pc.DensePerturbation(0.5, law="sphere", on_input=True)
    matrices = law.sample(jax.random.key(0), normal(1, 2, 2, 3), 4).dense()
    assert_close(jnp.linalg.norm(matrices, axis=(-2, -1)), np.full(4, 0.5 * np.sqrt(15)))


def test_expected_cost_of_a_dense_law_matches_the_moment_recursion():
    law = pc.Linear(pc.Uniform(-np.ones(4), np.ones(4)), 0.2 * normal(7, 15, 4), 0.1 * normal(8, 15))
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0.4 * normal(1, 3, 3), normal(2, 3, 2)),
        horizon=3,
        memory=2,
        gain=0.1 * normal(3, 2, 3),
        noise=pc.Gaussian([0.1, 0.0, -0.3], np.eye(3)),
        cost=pc.QuadraticCost(np.eye(3), np.eye(2)),
        perturbation=pc.DensePerturbation(ENTRYWISE, law=law, on_input=True),
        initial_state=[1.0, 0.0, 2.0],
    )
    M, deployed = 0.3 * normal(4, 2, 2, 3), 0.3 * normal(5, 2, 2, 3)
    exact = pc.expected_cost(problem, M, deployed=deployed)
    assert_close(exact, pc.expected_cost_by_moments(problem, M, deployed=deployed))
    estimate = pc.estimate_cost(problem, M, deployed=deployed, key=jax.random.key(1), samples=20_000)
    assert abs(float(estimate.mean - exact)) <= 5 * float(estimate.standard_error)


def check(**kwargs):
    pc.DensePerturbation(**{"scale": 0.5, **kwargs}).check((2, 2, 3), 3)


def test_negative_constant_scale_is_taken_where_the_law_need_not_be_symmetric():
    law = pc.DensePerturbation(-0.5, law=pc.Constant(np.arange(9.0)))
    assert_close(law.mean(jnp.zeros((1, 2, 3)), 1), -0.5 * np.arange(9.0).reshape(1, 3, 3))


REFUSED = {
    "unknown law": (lambda: pc.DensePerturbation(0.5, law="cauchy"), "law", "'cauchy'", "sphere"),
    "law in time": (lambda: pc.DensePerturbation(0.5, law=pc.Sequence(np.ones((3, 9)))), "law", "same at all times"),
    "negative scale": (lambda: pc.DensePerturbation(-0.5, law="sphere"), "scale", "-0.5", "absolute value"),
    "scale shape": (lambda: check(scale=np.ones(2)), "scale", "(2,)", "(3,)"),
    "scale of the state alone": (lambda: check(scale=np.ones((3, 3)), on_input=True), "scale", "(3, 5)"),
    "mean shape": (lambda: check(mean=np.ones((3, 5))), "mean", "(3, 5)", "(3, 3)"),
    "law dimension": (lambda: check(law=pc.Gaussian(np.zeros(3), np.eye(3))), "law", "dimension 3", "n p = 9"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_dense_perturbation_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
