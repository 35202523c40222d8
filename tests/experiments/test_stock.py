"""The stock-market experiment: what the paper prints, and its stable policies in all nine cases on both sets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.experiments import stock_market, stock_sensitivities
from perfcontrol.random_vectors.stochastic_volatility import growth_moments
from tests.oracles.moments import expected_cost_moments
from tests.tools import assert_close, assert_refused, tolerance

CASES = [(order, growth) for growth in (0.9, 0.98, 1.0) for order in ("ascending", "descending", "random")]
EXPOSURE = 6.5 / 17.5
SETS = ("rows", "simplex")

# Printed in Appendix A, in the order of the page.
PRINTED = {
    "ascending": [
        (0, [1.25797477e-07, 5.03189910e-07, 1.13217730e-06, 2.01275964e-06, 3.14493693e-06]),
        (18, [4.54128893e-05, 5.03189910e-05, 4.66004175e-03, 5.35796616e-03, 6.12231163e-03]),
        (38, [2.98487222e-02, 3.22041542e-02, 4.33504397e-02, 4.66004175e-02, 5.00089002e-02]),
        (56, [1.16484061e-01, 1.22722987e-01, 1.29180801e-01, 1.35861276e-01]),
    ],
    "random": [
        (0, [2.54880785e-02, 3.63554710e-05, 2.34768284e-02, 1.64885270e-02, 1.25797477e-07, 9.36417552e-02]),
        (6, [1.10460249e-02, 6.16407639e-06, 2.76110367e-02, 5.00089002e-02, 1.16484061e-01, 1.04647776e-01]),
        (12, [2.15742674e-02, 2.46563056e-05, 3.14493693e-06, 4.66004175e-03, 4.54128893e-05, 3.22041542e-02]),
        (18, [1.22722987e-02, 4.33504397e-02, 8.84406585e-03, 6.95609731e-03, 5.03189910e-05, 1.01895957e-05]),
        (24, [7.39997371e-02, 1.97773762e-02, 7.86234234e-02, 1.35861276e-02, 8.84406585e-02, 1.22722987e-01]),
        (30, [4.07583827e-05, 8.05103855e-06, 2.98487222e-02, 9.90428699e-03, 6.95609731e-02, 8.34358059e-02]),
        (36, [6.12231163e-03, 1.81148367e-05, 1.52214948e-05, 2.12597737e-05, 6.53033575e-02, 5.03189910e-07]),
        (42, [5.35796616e-03, 9.90428699e-02, 7.86234234e-03, 1.10460249e-01, 4.66004175e-02, 2.83044324e-05]),
        (48, [3.22041542e-05, 2.01275964e-06, 1.13217730e-06, 6.12231163e-02, 5.35796616e-02, 1.49905306e-02]),
        (54, [1.25797477e-05, 1.80831358e-02, 4.52870919e-06, 1.35861276e-01, 1.29180801e-01, 5.73164756e-02]),
    ],
}


@pytest.mark.parametrize("order", PRINTED)
def test_sensitivities_equal_the_printed_ones_to_all_nine_digits(order):
    values = stock_sensitivities(order)
    for first, printed in PRINTED[order]:
        ours = values[first : first + len(printed)]
        np.testing.assert_allclose(ours, printed, rtol=5.5e-9)


def test_sensitivities_are_the_same_numbers_in_every_order():
    ascending = stock_sensitivities("ascending")
    assert ascending.shape == (60,) and np.all(np.diff(ascending) > 0)
    np.testing.assert_array_equal(stock_sensitivities("descending"), ascending[::-1])
    np.testing.assert_array_equal(np.sort(stock_sensitivities("random")), ascending)
    assert ascending.sum() == pytest.approx(2.0, rel=1e-14)


@pytest.mark.float32
def test_stock_market_is_the_problem_that_the_paper_describes():
    problem = stock_market("descending", growth=0.97, initial_investment=120.0)
    assert (problem.horizon, problem.memory, problem.state_size, problem.input_size) == (60, 1, 20, 20)
    assert problem.policy_shape == (1, 10, 10)
    assert_close(problem.initial_state.mean, np.repeat([0.0, 120.0], 10))
    assert_close(problem.noise.mean, np.repeat([0.0, 0.5], 10), 1e-12, 1e-6)
    assert_close(problem.noise.covariance, np.kron(np.ones((2, 2)), np.eye(10)) / 12, 1e-12, 1e-6)
    assert_close(problem.perturbation.growth.log_sensitivity, np.log(stock_sensitivities("descending")), 1e-12, 1e-5)
    M = np.asarray(problem.feasible_set.project(0.001 * jnp.arange(100.0).reshape(1, 10, 10)), dtype=float)
    assert_close(problem.lift(M)[0], np.kron(np.eye(2), M[0]))
    assert_close(problem.initial_policy(), np.full((1, 10, 10), EXPOSURE / 10), 1e-12, 1e-6)

    paths = pc.simulate(problem, M, key=jax.random.key(0), samples=2)
    x, u, w = (np.asarray(array, dtype=float) for array in (paths.x, paths.u, paths.w))
    dense = np.asarray(jax.vmap(lambda draws: draws.dense())(paths.draws), dtype=float)
    close = tolerance(1e-9, 3e-3)
    for s in range(2):
        w_before = np.vstack([np.zeros(20), w[s]])
        np.testing.assert_allclose(u[s], w_before @ np.kron(np.eye(2), M[0]).T, atol=close)
        forward = np.einsum("tij,tj->ti", 0.97 * np.eye(20) + dense[s], x[s, :-1]) + u[s, :-1] + w[s]
        np.testing.assert_allclose(x[s, 1:], forward, atol=close * max(1, np.abs(x).max()))
        cost = (x[s, :, :10] ** 2).sum() + (u[s, :, :10] ** 2).sum()
        assert float(paths.cost[s]) == pytest.approx(cost, rel=tolerance(1e-12, 1e-4))


# --- stable policies -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=SETS)
def nine(request):
    """(case, problem, solution of StablePoint) of all nine cases on one set, by one compiled program."""
    problems = [stock_market(order, growth=growth, feasible_set=request.param) for order, growth in CASES]
    return [(case, problem, pc.solve(problem, pc.StablePoint())) for case, problem in zip(CASES, problems, strict=True)]


@pytest.mark.float32
def test_stable_policy_exists_and_is_unique_in_all_nine_cases(nine):
    for case, problem, solution in nine:
        assert float(solution.stats["residual"]) <= tolerance(1e-11, 1e-5), case
        assert bool(solution.stats["unique"]), case
        assert bool(problem.feasible_set.contains(solution.M, tolerance(1e-12, 1e-5))), case


def test_stable_policy_is_where_repeated_minimisation_goes_in_all_nine_cases(nine):
    for case, problem, solution in nine:
        repeated = pc.solve(problem, pc.RRM())
        assert_close(repeated.M, solution.M, 1e-9)
        assert bool(repeated.stats["unique"]), case
        rate = float(repeated.stats["rate"])  # nan where one minimisation ends it
        assert np.isnan(rate) or rate < 1e-3, case


def test_stable_policy_has_the_same_entries_for_all_identical_stocks(nine):
    for case, _, solution in nine:
        M = np.asarray(solution.M[0])
        alpha_beta, beta = M[0, 0], M[0, 1]
        np.testing.assert_allclose(M, (alpha_beta - beta) * np.eye(10) + beta, rtol=1e-9, atol=1e-13, err_msg=str(case))
        assert alpha_beta + 9 * beta == pytest.approx(EXPOSURE, rel=1e-12)


def test_stable_policy_is_the_same_from_random_feasible_starts(nine):
    for case, problem, solution in (nine[2], nine[7]):
        for seed in range(3):
            start = problem.feasible_set.project(jax.random.normal(jax.random.key(seed), (1, 10, 10)))
            assert_close(pc.solve(problem, pc.StablePoint(), start).M, solution.M, 1e-8)
            assert case in CASES


@pytest.mark.parametrize("nine", ["rows"], indirect=True)
def test_stable_policy_is_stationary_for_the_dense_moment_oracle(nine):
    """The cost of nearby feasible policies in the world of the stable one, from NumPy moments of the paper's model."""
    for (order, growth), _, solution in (nine[1], nine[8]):
        stable = np.asarray(solution.M[0])
        world = lambda M, order=order, growth=growth, stable=stable: _oracle_cost(M, stable, order, growth)  # noqa: E731
        rng = np.random.default_rng(0)
        for _ in range(2):
            direction = rng.normal(size=(10, 10))
            direction -= direction.mean(axis=1, keepdims=True)
            direction *= 0.01 / np.abs(direction).max()
            up, here, down = (world(stable + sign * direction) for sign in (1, 0, -1))
            curvature, slope = up - 2 * here + down, (up - down) / 2
            assert curvature > 0 and abs(slope) < 1e-6 * curvature


def _oracle_cost(M: np.ndarray, deployed: np.ndarray, order: str, growth: float) -> float:
    """Appendix A in the oracle's terms: Δ_t = [[E V - I, V - E V], [0, V - I]], V = diag(portfolio e_t)."""
    first, variance = growth_moments(np.log(stock_sensitivities(order)), 0.05, "lognormal")
    second = variance + first**2
    portfolio = deployed / EXPOSURE
    gram = portfolio @ portfolio.T
    eye, zero = np.eye(10), np.zeros((10, 10))
    shown = np.block([[eye, zero], [zero, zero]])
    mean = np.stack([np.kron(np.eye(2), np.diag(g * portfolio.sum(axis=1) - 1)) for g in first])

    def spread(t: int, X: np.ndarray) -> np.ndarray:
        return np.kron(np.ones((2, 2)), (second[t] - first[t] ** 2) * gram * X[10:, 10:])

    return expected_cost_moments(
        A=np.broadcast_to(growth * np.eye(20), (60, 20, 20)),
        B=np.broadcast_to(np.eye(20), (60, 20, 20)),
        K=np.zeros((61, 20, 20)),
        Q=np.broadcast_to(shown, (61, 20, 20)),
        R=np.broadcast_to(shown, (61, 20, 20)),
        M=np.kron(np.eye(2), M)[None],
        noise_mean=np.broadcast_to(np.repeat([0.0, 0.5], 10), (60, 20)),
        noise_covariance=np.broadcast_to(np.kron(np.ones((2, 2)), eye) / 12, (60, 20, 20)),
        perturbation_mean=mean,
        covariance_apply=spread,
        initial_mean=np.repeat([0.0, 150.0], 10),
        initial_covariance=np.zeros((20, 20)),
    )


@pytest.mark.float32
@pytest.mark.parametrize("nine", ["rows"], indirect=True)
def test_exact_cost_within_five_standard_errors_of_monte_carlo(nine):
    for case, problem, solution in (nine[0], nine[4]):
        estimate = pc.estimate_cost(problem, solution.M, key=jax.random.key(1), samples=2048)
        exact = float(pc.expected_cost(problem, solution.M))
        assert abs(float(estimate.mean) - exact) <= 5 * float(estimate.standard_error) + tolerance(0, 1e-3) * exact, (
            case
        )


# --- the paper's algorithm -------------------------------------------------------------------------------------------


def test_rsgd_approaches_the_stable_policy_when_the_step_diminishes_in_the_unstable_regime():
    problem = stock_market("descending", growth=1.0)
    stable = pc.solve(problem, pc.StablePoint()).M
    solver = pc.RSGD(800, pc.InverseStep(0.1 / 60, 10))

    def errors(key):
        return pc.solve(problem, solver, key=key, record=lambda M: jnp.sum((M - stable) ** 2), every=100).history

    error = np.median(np.asarray(jax.jit(jax.vmap(errors))(jax.random.split(jax.random.key(2), 8))), axis=0)
    assert np.all(np.isfinite(error)) and error[8] < 0.35 * error[1] and error[8] < 0.1 * error[0]


# --- as printed ------------------------------------------------------------------------------------------------------


def test_nothing_depends_on_the_policy_when_the_volatility_is_as_printed():
    problem = stock_market(volatility="as_printed")
    one, two = (problem.feasible_set.project(jax.random.normal(jax.random.key(k), (1, 10, 10))) for k in (1, 2))
    variance = np.asarray(problem.perturbation.growth.variance)
    assert np.abs(variance).max() < 1e-12
    means = [problem.perturbation.mean(problem.lift(M), 60) for M in (one, two)]
    assert_close(means[0], means[1], 1e-12)
    costs = [float(pc.expected_cost(problem, one, deployed=M)) for M in (one, two)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-11)
    assert float(pc.expected_cost(problem, two, deployed=two)) != pytest.approx(costs[0], rel=1e-3)
    expected = np.exp((0.05 - 0.18) / 60 - 0.6 / np.sqrt(60))
    assert_close(problem.perturbation.growth.first_moment, np.full(60, expected), 1e-12)


# --- bad input -------------------------------------------------------------------------------------------------------

REFUSED = {
    "order": (lambda: stock_market("sorted"), "order", "'sorted'", "ascending"),
    "sensitivities": (lambda: stock_sensitivities("shuffled"), "order", "'shuffled'"),
    "set": (lambda: stock_market(feasible_set="ball"), "feasible_set", "'ball'", "simplex"),
    "volatility": (lambda: stock_market(volatility="normal"), "volatility", "'normal'", "as_printed"),
    "hours": (lambda: stock_market(trading_hours=24), "trading_hours", "24"),
    "no hours": (lambda: stock_market(trading_hours=0), "trading_hours", "between 0 and 24"),
    "growth": (lambda: stock_market(growth=[1.0, 1.0]), "growth", "(2,)", "one number"),
    "infinite growth": (lambda: stock_market(growth=float("inf")), "growth", "finite"),
    "investment": (lambda: stock_market(initial_investment=[1.0, 2.0]), "initial_investment", "(2,)", "one number"),
    "rate": (lambda: stock_market(rate=float("nan")), "rate", "finite"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_stock_market_is_refused_with_a_four_part_error(case):
    assert_refused(*case)


def test_stock_policy_is_refused_when_lifted_or_infeasible():
    problem = stock_market()
    assert_refused(lambda: pc.expected_cost(problem, np.zeros((1, 20, 20))), "M", "(1, 10, 10)", "lifted")
    assert_refused(lambda: pc.expected_cost(problem, np.zeros((10, 10))), "M", "lag axis")
    assert_refused(lambda: pc.solve(problem, pc.StablePoint(), np.zeros((1, 10, 10))), "M0", "feasible")
    assert_refused(lambda: pc.solve(problem, pc.RSGD(5, 0.01)), "key", "jax.random.key(0)")
