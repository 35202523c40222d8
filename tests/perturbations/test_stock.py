"""The paper's stock market."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import perfcontrol as pc
from perfcontrol.random_vectors.stochastic_volatility import growth_moments
from tests.contracts.perturbation import PerturbationContract
from tests.tools import assert_close, assert_refused, normal

SENSITIVITIES = [0.05, 0.5, 0.02]
EXPOSURE = 0.4


class StockContract(PerturbationContract):
    same_mean = 1e-12  # row sums are rounded
    shape = (1, 4, 4)
    samples = 4_000
    structure = pc.RepeatedBlock(2)
    volatility = "lognormal"

    def perturbation(self):
        return pc.StockPerturbation(
            pc.StochasticVolatility(SENSITIVITIES, 0.05, self.volatility, self.shape[-1] // 2), EXPOSURE
        )


class TestOnTheSimplex(StockContract):
    feasible_set = pc.RowSimplex(EXPOSURE)


class TestOnASimplexOfUnequalRows(StockContract):
    feasible_set = pc.RowSimplex([[0.2, 0.4]])


class TestOnRowSums(StockContract):
    feasible_set = pc.RowSum(EXPOSURE)
    knows = ("mean", "covariance", "sensitivity")


class TestOnABall(StockContract):
    feasible_set = pc.FrobeniusBall(0.7)


class TestWithoutStructure(StockContract):
    structure = pc.FullStructure()
    feasible_set = pc.RowSimplex(EXPOSURE)


class StocksOfTheirOwn(StockContract):
    """Drifts, volatilities and a correlation; the mean of Δ then depends on the policy even where row sums do not."""

    shape = (1, 6, 6)
    knows = ("mean", "covariance", "sensitivity")
    drift = np.array([0.1, -0.05, 0.02])
    spread = np.array([[0.3, 0.2, 0.0], [0.2, 0.4, -0.1], [0.0, -0.1, 0.1]])

    def perturbation(self):
        return pc.StockPerturbation(pc.LogNormal(self.drift, self.spread), EXPOSURE)


class TestStocksOfTheirOwnOnTheSimplex(StocksOfTheirOwn):
    feasible_set = pc.RowSimplex(EXPOSURE)


class TestStocksOfTheirOwnOnRowSums(StocksOfTheirOwn):
    feasible_set = pc.RowSum(EXPOSURE)


class TestStocksThatVaryInTime(StocksOfTheirOwn):
    feasible_set = pc.FrobeniusBall(0.7)
    spread = np.array([1.0, 0.2, 0.0])[:, None, None] * StocksOfTheirOwn.spread


class TestRecordedDays(StocksOfTheirOwn):
    feasible_set = pc.RowSimplex(EXPOSURE)
    knows = ("mean", "covariance", "bound", "sensitivity")

    def perturbation(self):
        days = [[1.1, 0.9, 1.0], [0.8, 0.7, 1.2], [1.0, 1.5, 1.0], [1.0, 1.0, 0.6]]
        return pc.StockPerturbation(pc.Empirical(days), EXPOSURE)


class TestRecordedDaysOnABall(TestRecordedDays):
    feasible_set = pc.FrobeniusBall(0.7)


class TestAsPrinted(StockContract):
    feasible_set = pc.RowSimplex(EXPOSURE)
    volatility = "as_printed"


@pytest.mark.parametrize("kind", ["lognormal", "as_printed"])
def test_growth_moments_match_adaptive_quadrature(kind):
    """Sensitivities on both sides of the clip, integrated piece by piece between its kinks."""
    sensitivities, rate = np.array([0.01, 0.3, 0.6, 1.5, 3.0]), 0.05
    first, variance = growth_moments(np.log(sensitivities), rate, kind)
    second = variance + first**2
    for t, sensitivity in enumerate(sensitivities):

        def growth(z, sensitivity=sensitivity):
            gaussian = np.log(sensitivity) + 0.2 * z
            v = np.clip(np.exp(gaussian) if kind == "lognormal" else gaussian, -0.6, 0.6)
            return np.exp((rate - v**2 / 2) / 5 + v / np.sqrt(5))

        ends = [np.log(0.6)] if kind == "lognormal" else [-0.6, 0.6]
        kinks = sorted(np.clip((np.array(ends) - np.log(sensitivity)) / 0.2, -10, 10))
        for power, moment in ((1, first), (2, second)):
            exact = scipy.integrate.quad(
                lambda z, power=power, growth=growth: growth(z) ** power * np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi),
                -10,
                10,
                points=kinks,
                epsabs=1e-14,
                epsrel=1e-13,
                limit=200,
            )[0]
            assert moment[t] == pytest.approx(exact, rel=1e-12)


def test_stock_moments_match_their_closed_form():
    """E V = g₁ (row sums), Cov V = (g₂ - g₁²) (portfolio portfolioᵀ) on the diagonals of Δ's blocks."""
    law = pc.StockPerturbation(pc.StochasticVolatility(SENSITIVITIES, 0.05, stocks=3), EXPOSURE)
    block = np.abs(np.asarray(normal(1, 1, 3, 3)))
    M = pc.RepeatedBlock(2).lift(jnp.asarray(block))
    portfolio = block[0] / EXPOSURE
    g1, variance = growth_moments(np.log(SENSITIVITIES), 0.05, "lognormal")
    mean = law.mean(M, 3)
    X, Y = normal(2, 6, 6), normal(3, 6, 6)
    applied, pulled = law.covariance(M, 3).apply(X), law.covariance(M, 3).adjoint(Y)
    for t in range(3):
        assert_close(mean[t], np.diag(np.tile(g1[t] * portfolio.sum(axis=1) - 1, 2)))
        spread = variance[t] * portfolio @ portfolio.T
        down, right = np.vstack([np.eye(3), np.eye(3)]), np.hstack([np.zeros((3, 3)), np.eye(3)])
        # Δ - Θ = down diag(V - E V) right
        assert_close(applied[t], down @ (spread * (right @ X @ right.T)) @ down.T)
        assert_close(pulled[t], right.T @ (spread * (down.T @ Y @ down)) @ right)


def test_as_printed_volatility_has_next_to_no_variance():
    """The Gaussian of the paper's sensitivities is below the clip: v = -0.6, and nothing reacts."""
    growth = pc.StochasticVolatility([0.001, 0.05, 0.1], 0.05, "as_printed", stocks=3)
    law = pc.StockPerturbation(growth, EXPOSURE)
    M = pc.RepeatedBlock(2).lift(jnp.full((1, 3, 3), EXPOSURE / 3))
    drawn = np.asarray(law.sample(jax.random.key(0), M, 3).dense())
    assert np.abs(drawn - np.asarray(law.mean(M, 3))).max() < 1e-9


def test_moments_of_correlated_stocks_match_enumeration_of_recorded_days():
    days = np.array([[1.1, 0.9, 1.0], [0.8, 0.7, 1.2], [1.0, 1.5, 1.0], [1.0, 1.0, 0.6]])
    law = pc.StockPerturbation(pc.Empirical(days), EXPOSURE)
    block = np.asarray(normal(5, 1, 3, 3))
    M = pc.RepeatedBlock(2).lift(jnp.asarray(block))
    V = np.stack([np.diag(block[0] / EXPOSURE @ day) for day in days])
    mean, zero = V.mean(axis=0), np.zeros((3, 3))
    draws = np.stack([np.block([[mean - np.eye(3), one - mean], [zero, one - np.eye(3)]]) for one in V])
    centred = draws - draws.mean(axis=0)
    X, Y = np.asarray(normal(2, 6, 6)), np.asarray(normal(3, 6, 6))
    for t in range(2):
        assert_close(law.mean(M, 2)[t], draws.mean(axis=0))
        assert_close(law.covariance(M, 2).apply(jnp.asarray(X))[t], np.mean([D @ X @ D.T for D in centred], axis=0))
        assert_close(law.covariance(M, 2).adjoint(jnp.asarray(Y))[t], np.mean([D.T @ Y @ D for D in centred], axis=0))
    drawn = np.asarray(law.sample(jax.random.key(0), M, 5).dense())
    assert all(np.abs(draws - one).max(axis=(1, 2)).min() < 1e-5 for one in drawn)


def test_means_are_free_of_the_policy_only_where_stocks_grow_alike():
    lifted = TestStocksOfTheirOwnOnRowSums().lifted_set()
    assert not pc.StockPerturbation(pc.LogNormal([0.1, 0.1, 0.0], np.eye(3)), EXPOSURE).policy_free_mean(lifted)
    assert pc.StockPerturbation(pc.LogNormal([0.1, 0.1, 0.1], np.eye(3)), EXPOSURE).policy_free_mean(lifted)


def paper(sensitivities, **changes):
    return pc.StochasticVolatility(sensitivities, **({"rate": 0.05} | changes))


def fit(growth, shape, horizon):
    return pc.StockPerturbation(growth, 0.4).resize(shape, horizon)


STOCKS_REFUSED = {
    "negative": (lambda: paper([0.1, -0.1]), "sensitivities", "positive"),
    "matrix": (lambda: paper([[0.1]]), "sensitivities", "(1, 1)"),
    "volatility": (lambda: paper([0.1], volatility="normal"), "volatility", "'normal'"),
    "rate": (lambda: paper([0.1], rate=[0.05]), "rate", "(1,)"),
    "stocks": (lambda: paper([0.1], stocks=0), "stocks", "at least 1"),
    "no law": (lambda: pc.StockPerturbation([0.1], 0.4), "growth", "pc.LogNormal(mean, covariance)"),
    "exposure": (lambda: pc.StockPerturbation(paper([0.1]), [0.4]), "exposure", "(1,)"),
    "odd state": (lambda: fit(paper([0.1]), (1, 3, 3), 1), "perturbation", "2L"),
    "days": (lambda: fit(paper([0.1]), (1, 4, 4), 3), "growth", "cover the horizon of 3"),
    "stocks of another market": (lambda: fit(pc.LogNormal(np.zeros(3), np.eye(3)), (1, 4, 4), 3), "growth", "3"),
}


@pytest.mark.parametrize("case", STOCKS_REFUSED.values(), ids=STOCKS_REFUSED.keys())
def test_stock_perturbation_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
