"""Laws of the noise and of the initial state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import perfcontrol as pc
from perfcontrol.random_vectors import random_signs
from tests.contracts.random_vector import RandomVectorContract
from tests.tools import assert_close, assert_mean_is, assert_refused, normal, tolerance

COVARIANCE = np.array([[2.0, 0.6, 0.0], [0.6, 1.0, -0.3], [0.0, -0.3, 0.5]])
RANK_TWO = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 4.0]])


class TestUniform(RandomVectorContract):
    def law(self):
        return pc.Uniform([-1.0, 0.0, 2.0], [2.0, 0.5, 2.0])


class TestUniformOfNumbers(RandomVectorContract):
    def law(self):
        return pc.Uniform(-2.0, 1.0).resize(2)


class TestRademacher(RandomVectorContract):
    def law(self):
        return pc.Rademacher([0.5, 2.0], mean=[1.0, -3.0])


class TestRademacherOfNumbers(RandomVectorContract):
    def law(self):
        return pc.Rademacher(0.5).resize(3)


class TestGaussian(RandomVectorContract):
    def law(self):
        return pc.Gaussian([1.0, -1.0, 0.0], COVARIANCE)


class TestGaussianOfSingularCovariance(RandomVectorContract):
    def law(self):
        return pc.Gaussian([0.0, 0.0, 5.0], RANK_TWO)


class TestTruncatedGaussian(RandomVectorContract):
    def law(self):
        return pc.TruncatedGaussian([0.3, 0.0, -1.0], COVARIANCE, bound=1.2)


class TestTruncatedGaussianOfSingularCovariance(RandomVectorContract):
    def law(self):
        return pc.TruncatedGaussian([0.0, 1.0, 0.0], RANK_TWO, bound=2.0)


class TestTruncatedGaussianOfOneComponent(RandomVectorContract):
    def law(self):
        return pc.TruncatedGaussian([2.0], [[4.0]], bound=0.5)


class TestConstant(RandomVectorContract):
    samples = 10

    def law(self):
        return pc.Constant([1.0, -2.0])


class TestSequence(RandomVectorContract):
    samples = 10

    def law(self):
        return pc.Sequence([[1.0, 2.0], [0.0, -5.0], [3.0, 1.0], [0.5, 0.5]])


class TestEmpirical(RandomVectorContract):
    def law(self):
        return pc.Empirical([[0.0, 1.0], [2.0, 1.0], [-1.0, 4.0], [-1.0, 4.0], [0.5, 0.0]])


class TestLogNormal(RandomVectorContract):
    def law(self):
        return pc.LogNormal([0.2, -0.1, 0.0], 0.2 * COVARIANCE)


class TestLogNormalOfSingularCovarianceThatVariesInTime(RandomVectorContract):
    def law(self):
        return pc.LogNormal([0.2, -0.1, 0.0], np.stack([0.1 * RANK_TWO, 0 * RANK_TWO]))


class TestLogNormalOfMeanThatVariesInTime(RandomVectorContract):
    def law(self):
        return pc.LogNormal([[0.2, -0.1], [0.0, 0.5]], 0.1 * np.eye(2))


class TestStochasticVolatility(RandomVectorContract):
    def law(self):
        return pc.StochasticVolatility([0.05, 0.5, 0.6], 0.1, stocks=2)


class TestStochasticVolatilityAsPrinted(RandomVectorContract):
    def law(self):
        return pc.StochasticVolatility([0.5, 1.5], 0.1, "as_printed").resize(3)


class TestLinear(RandomVectorContract):
    def law(self):
        return pc.Linear(pc.Uniform(0.0, 1.0), [[1.0, 2.0], [0.0, -1.0], [1.0, 1.0]], offset=[0.0, 1.0, -2.0])


class TestLinearOfSequence(RandomVectorContract):
    samples = 10

    def law(self):
        return pc.Linear(pc.Sequence([[1.0, 2.0], [0.0, -5.0]]), [[1.0, 1.0]], offset=0.5)


class TestLinearOfUnboundedLaw(RandomVectorContract):
    def law(self):
        return pc.Linear(pc.Gaussian([0.0], [[1.0]]), [[1.0], [2.0]])


def test_uniform_moments_match_closed_form():
    law = pc.Uniform([-1.0, 0.0], [2.0, 6.0])
    assert_close(law.mean, [0.5, 3.0])
    assert_close(law.covariance, np.diag([9 / 12, 36 / 12]))
    assert float(law.bound) == pytest.approx(np.hypot(2, 6))


def test_log_normal_moments_match_scipy_and_a_gaussian_identity():
    law = pc.LogNormal([0.3, -0.2, 0.1], COVARIANCE)
    for i in range(3):
        one = scipy.stats.lognorm(s=np.sqrt(COVARIANCE[i, i]), scale=np.exp([0.3, -0.2, 0.1][i]))
        assert float(law.mean[i]) == pytest.approx(one.mean(), rel=1e-12)
        assert float(law.covariance[i, i]) == pytest.approx(one.var(), rel=1e-12)
    # E e^g₀ e^g₁ is the mean of the log-normal variable exp(g₀ + g₁)
    both = scipy.stats.lognorm(s=np.sqrt(2.0 + 1.0 + 2 * 0.6), scale=np.exp(0.3 - 0.2)).mean()
    assert float(law.covariance[0, 1] + law.mean[0] * law.mean[1]) == pytest.approx(both, rel=1e-12)


def test_truncated_gaussian_covariance_matches_scipy_in_one_dimension():
    law = pc.TruncatedGaussian([2.0], [[4.0]], bound=1.5)
    expected = 4 * scipy.stats.truncnorm(-1.5, 1.5).var()
    assert float(law.covariance[0, 0]) == pytest.approx(expected, rel=1e-12)


def test_truncated_gaussian_radius_follows_the_truncated_chi_law():
    law = pc.TruncatedGaussian(np.zeros(3), np.eye(3), bound=1.7)
    radii = np.linalg.norm(law.sample(jax.random.key(0), 20_000), axis=-1)
    chi = scipy.stats.chi(3)
    statistic = scipy.stats.kstest(radii, lambda r: np.minimum(chi.cdf(r) / chi.cdf(1.7), 1)).statistic
    assert statistic < 5 * 0.5 / np.sqrt(radii.size)


def test_truncated_gaussian_tends_to_the_gaussian_for_a_wide_bound():
    assert_close(pc.TruncatedGaussian(np.zeros(3), COVARIANCE, bound=40.0).covariance, COVARIANCE)


def test_empirical_covariance_is_that_of_the_sample_itself():
    samples = np.asarray(normal(1, 7, 3))
    assert_close(pc.Empirical(samples).covariance, np.cov(samples.T, bias=True))


def test_linear_moments_match_the_matrix_products():
    matrix = np.asarray(normal(2, 4, 3))
    law = pc.Linear(pc.Gaussian([1.0, 2.0, 3.0], COVARIANCE), matrix, offset=1.0)
    assert_close(law.mean, 1 + matrix @ [1.0, 2.0, 3.0])
    assert_close(law.covariance, matrix @ COVARIANCE @ matrix.T)


@pytest.mark.parametrize("count", [1, 31, 32, 33, 1000])
def test_random_signs_are_plus_and_minus_one_of_the_asked_shape(count):
    signs = random_signs(jax.random.key(count), (count, 2), jnp.float32)
    assert signs.shape == (count, 2) and set(np.unique(signs)) <= {-1.0, 1.0}


def test_random_signs_within_one_word_are_independent_and_fair():
    signs = np.asarray(random_signs(jax.random.key(4), (20_000, 32), float))
    assert_mean_is(signs, np.zeros(32))
    products = signs[:, :, None] * signs[:, None, :]
    assert_mean_is(products, np.eye(32))


@pytest.mark.float32
def test_laws_keep_the_default_precision():
    dtype = jnp.result_type(float)
    for law in (pc.Uniform([0], [1]), pc.Gaussian([0], [[1]]), pc.TruncatedGaussian([0], [[1]], 2), pc.Rademacher([1])):
        assert law.mean.dtype == law.sample(jax.random.key(0), 2).dtype == dtype
        assert tolerance(8, 4) == dtype.itemsize


LAWS_REFUSED = {
    "low above high": (lambda: pc.Uniform([0.0, 1.0], [1.0, 0.5]), "low", "not exceed `high`"),
    "lengths that differ": (lambda: pc.Uniform([0.0, 1.0], [1.0, 2.0, 3.0]), "high", "(3,)", "(2,)"),
    "negative scale": (lambda: pc.Rademacher([1.0, -2.0]), "scale", "-2", "absolute value"),
    "matrix for a vector": (lambda: pc.Rademacher(np.eye(2)), "scale", "(2, 2)"),
    "nan": (lambda: pc.Uniform([0.0, np.nan], 1.0), "low", "nan at index [1]", "finite"),
    "infinite": (lambda: pc.Constant([np.inf]), "value", "inf at index [0]"),
    "words": (lambda: pc.Constant("zero"), "value", "array of real numbers"),
    "complex": (lambda: pc.Constant([1j]), "value", "complex"),
    "ragged": (lambda: pc.Sequence([[1.0], [1.0, 2.0]]), "values", "rectangular"),
    "covariance shape": (lambda: pc.Gaussian([0.0, 0.0], np.eye(3)), "covariance", "(3, 3)", "(2, 2)"),
    "covariance asymmetric": (lambda: pc.Gaussian([0, 0], [[1, 0.5], [0, 1]]), "covariance", "symmetric", "0.5"),
    "covariance indefinite": (lambda: pc.Gaussian([0, 0], [[1, 2], [2, 1]]), "covariance", "semidefinite", "-1"),
    "truncated indefinite": (lambda: pc.TruncatedGaussian([0, 0], [[1, 2], [2, 1]], 1), "covariance", "semidefinite"),
    "gaussian mean": (lambda: pc.Gaussian(0.0, [[1.0]]), "mean", "vector"),
    "bound zero": (lambda: pc.TruncatedGaussian([0.0], [[1.0]], 0.0), "bound", "positive"),
    "bound vector": (lambda: pc.TruncatedGaussian([0.0], [[1.0]], [1.0]), "bound", "(1,)"),
    "log mean": (lambda: pc.LogNormal(0.1, np.eye(2)), "mean", "(T, n)"),
    "two lengths": (lambda: pc.LogNormal(np.zeros((2, 2)), np.zeros((3, 2, 2))), "covariance", "as many as the mean"),
    "log covariance": (lambda: pc.LogNormal([0, 0], [[1, 2], [2, 1]]), "covariance", "semidefinite"),
    "constant matrix": (lambda: pc.Constant(np.eye(2)), "value", "Sequence"),
    "sequence vector": (lambda: pc.Sequence([1.0, 2.0]), "values", "(time, n)"),
    "no samples": (lambda: pc.Empirical(np.zeros((0, 2))), "samples", "at least one"),
    "linear matrix": (lambda: pc.Linear(pc.Uniform(0, 1), [1.0, 2.0]), "matrix", "(n, k)"),
    "linear columns": (lambda: pc.Linear(pc.Constant([1.0, 2.0]), np.eye(3)), "matrix", "2 columns"),
    "linear offset": (lambda: pc.Linear(pc.Constant([1.0, 2.0]), np.eye(2), [1.0]), "offset", "(1,)", "(2,)"),
}


@pytest.mark.parametrize("case", LAWS_REFUSED.values(), ids=LAWS_REFUSED.keys())
def test_law_is_refused_with_a_four_part_error(case):
    assert_refused(*case)


def test_stochastic_volatility_is_that_of_the_normals_of_its_key():
    key, epsilon = jax.random.key(0), np.array([0.05, 0.5, 0.6])
    v = np.minimum(np.exp(np.log(epsilon)[:, None] + 0.2 * np.asarray(jax.random.normal(key, (3, 2)))), 0.6)
    expected = np.exp((0.1 - v**2 / 2) / 3 + v / np.sqrt(3))
    assert_close(pc.StochasticVolatility(epsilon, 0.1, stocks=2).sample(key, 3), expected, 1e-14)
