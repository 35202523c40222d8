"""The cheapest policies of the stock market against a recursion by hand and the general solver."""

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

import perfcontrol as pc
from perfcontrol.config import REGIMES
from perfcontrol.experiments.reproduce.optimum import lower_bound, optimal_policy, symmetric
from perfcontrol.experiments.stock import HORIZON, STOCKS, stock_sensitivities
from tests.tools import assert_close, normal

EXPOSURE, RATE, INVESTMENT = 6.5 / 17.5, 0.05, 150.0


def growth(sensitivity):
    """Mean and variance of exp((r - v²/2)/T + v/√T), v = min(exp N(log ε, 0.2²), 0.6), by quadrature."""

    def price(z):
        v = min(np.exp(np.log(sensitivity) + 0.2 * z), 0.6)
        return np.exp((RATE - v**2 / 2) / HORIZON + v / np.sqrt(HORIZON))

    def mean(function):
        kink = np.clip((np.log(0.6) - np.log(sensitivity)) / 0.2, -8.9, 8.9)
        parts = ((-9, kink), (kink, 9))
        weight = lambda z: np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)  # noqa: E731
        return sum(
            scipy.integrate.quad(lambda z: function(price(z)) * weight(z), *ends, epsrel=1e-12)[0] for ends in parts
        )

    first = mean(lambda e: e)
    return first, mean(lambda e: (e - first) ** 2)


def cost_of_one_stock(row, deployed, rho, moments):
    """E Σ r_t² + (row (w_{t-1} - 1/2))², the first entry of the row being the stock's own."""
    own, square, total = row[0], np.sum(row**2), np.sum(row)
    r2, q1, q2, cost = 0.0, INVESTMENT, INVESTMENT**2, 0.0
    for t in range(HORIZON + 1):
        seen = t > 0  # there is a w_{t-1}
        cost += r2 + seen * square / 12
        if t == HORIZON:
            return cost
        first, variance = moments[t]
        phi, v = rho + first * np.sum(deployed) / EXPOSURE - 1, variance * np.sum(deployed**2) / EXPOSURE**2
        with_r = with_q = seen * own / 12  # covariances of r_t and q_t with row w_{t-1}, both by w_{l,t-1}
        u1 = seen * total / 2
        r2 = phi**2 * r2 + v * q2 + seen * square / 12 + 1 / 12 + 2 * phi * with_r
        u2, uq = u1**2 + seen * square / 12, u1 * q1 + with_q
        q2 = (phi**2 + v) * q2 + 2 * phi * uq + u2 + 1 / 3 + phi * q1 + u1
        q1 = phi * q1 + u1 + 1 / 2
    return cost


@pytest.fixture(scope="module")
def moments():
    return {order: [growth(e) for e in stock_sensitivities(order)] for order in ("descending",)}


def test_cost_is_a_sum_over_stocks_that_see_the_norms_of_their_own_rows(moments):
    """The recursion by hand, for rows that are not alike and another deployed policy."""
    problem = pc.experiments.stock_market("descending", growth=0.96)
    M, deployed = (problem.feasible_set.project(normal(seed, 1, STOCKS, STOCKS)) for seed in (0, 1))
    expected = sum(
        cost_of_one_stock(np.roll(np.asarray(M)[0, l], -l), np.asarray(deployed)[0, l], 0.96, moments["descending"])
        for l in range(STOCKS)  # noqa: E741
    )
    assert_close(pc.expected_cost(problem, M, deployed=deployed), expected, 1e-10)


@pytest.mark.parametrize("regime", REGIMES)
def test_optimum_is_that_of_a_search_over_one_stock_by_hand(moments, regime):
    """Over the diagonal and one other entry, the rest alike: the optimum has them all alike."""
    rho = REGIMES[regime]
    problem = pc.experiments.stock_market("descending", growth=rho)
    d, cost, lower, cells = optimal_policy(problem)

    def by_hand(x):
        rest = (EXPOSURE - x[0] - x[1]) / (STOCKS - 2)
        row = np.array([x[0], x[1], *[rest] * (STOCKS - 2)])
        return STOCKS * cost_of_one_stock(row, row, rho, moments["descending"])

    starts = [(-0.8, 0.2), (0.0, 0.0), (0.5, -0.3)]
    found = min((scipy.optimize.minimize(by_hand, s, tol=1e-10) for s in starts), key=lambda end: end.fun)
    assert_close(cost, found.fun, 1e-8)
    assert_close(found.x, [EXPOSURE / STOCKS + d, EXPOSURE / STOCKS - d / (STOCKS - 1)], 1e-3)
    assert (1 - 1e-3) * cost <= lower <= cost and 1 < cells < 500
    assert_close(pc.expected_cost(problem, symmetric(problem, d)), cost, 1e-12)


def test_lower_bound_is_below_every_policy_tried():
    problem = pc.experiments.stock_market("random", growth=1.0)
    _, cost, lower, _ = optimal_policy(problem, gap=0.05)
    assert lower >= 0.95 * cost
    for spread in (0.01, 0.1, 0.3):
        for seed in range(5):
            M = problem.feasible_set.project(spread * normal(seed, *problem.policy_shape))
            assert float(pc.expected_cost(problem, M)) >= cost >= lower


@pytest.mark.parametrize("ends", [(-0.9, -0.6), (-0.3, 0.2), (0.1, 0.5), (0.4, 0.41)])
def test_bound_of_an_interval_is_below_its_costs_and_near_them_where_it_is_short(ends):
    problem = pc.experiments.stock_market("descending", growth=0.96)
    costs = [float(pc.expected_cost(problem, symmetric(problem, d))) for d in np.linspace(*ends, 21)]
    once, _ = lower_bound(problem, ends, -np.inf)
    rounded = min(costs) * (1 + 1e-12)
    assert once <= rounded
    often, cells = lower_bound(problem, ends, 0.99 * min(costs))
    assert once <= often <= rounded and often >= 0.99 * min(costs) and cells < 100


def test_on_the_simplex_nothing_of_the_own_stock_is_bought_and_stable_is_optimal():
    problem = pc.experiments.stock_market("descending", feasible_set="simplex")
    d, cost, lower, _ = optimal_policy(problem)
    assert d == pytest.approx(-EXPOSURE / STOCKS, rel=1e-9) and lower > 0.999 * cost
    stable = pc.solve(problem, pc.StablePoint()).M
    assert_close(stable, symmetric(problem, d), 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("feasible_set", ["rows", "simplex"])
def test_general_bound_encloses_the_same_optimum_in_all_nine_cases(feasible_set):
    for rho in REGIMES.values():
        for order in ("ascending", "descending", "random"):
            problem = pc.experiments.stock_market(order, growth=rho, feasible_set=feasible_set)
            _, cost, lower, _ = optimal_policy(problem)
            bound = pc.optimality_bound(problem)
            assert_close(bound.upper, cost, 1e-8)
            assert bound.lower <= cost and lower <= bound.upper and bound.closed
