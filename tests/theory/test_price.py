"""The price of stability against closed forms of the literature and enumeration with outer solvers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import perfcontrol as pc
from perfcontrol.theory import price as price_module
from perfcontrol.theory.price import in_figures
from tests.oracles import performative_optima
from tests.oracles.enumeration import enumerate_cost
from tests.solvers.test_long_run import CENTRE, HEIGHT, WIDTH, F, belt, belt_response
from tests.theory.problems import prediction_problem, random_problem
from tests.tools import assert_close, assert_refused

# --- closed forms ----------------------------------------------------------------------------------------------------


def location(mean, sensitivity, penalty, deviation=0.1):
    """Decisions (naive: z as under the decision 0) and what a decision costs."""
    _, stable, optimal = performative_optima.location(mean, sensitivity, penalty, deviation)
    decisions = mean / (1 + penalty), stable, optimal
    return decisions, lambda d: ((mean + sensitivity * d - d) ** 2 + deviation**2 + penalty * d**2) / 2


def pricing(mean, sensitivity):
    """With the demand as it was at no price, the naive price is the highest allowed: revenue grows without end."""
    _, stable, optimal = performative_optima.pricing(mean, sensitivity)
    top = 10 * mean**2 / (4 * sensitivity)
    return (2 * stable, stable, optimal), lambda d: (top - d * (mean - sensitivity * d)) ** 2


def scale(mean, slope):
    """The spread does not move what is best in a given world: naive and stable agree."""
    _, stable, optimal = performative_optima.scale(mean, slope)
    return (stable, stable, optimal), lambda d: ((mean - d) ** 2 + (slope * d) ** 2) / 2


CLOSED = {
    "location, retraining pays": (performative_optima.location, location, (10.0, 0.4, 0.5)),
    "location, retraining runs away": (performative_optima.location, location, (10.0, 3.0, 0.5)),
    "pricing": (performative_optima.pricing, pricing, (3.0, 0.8)),
    "scale": (performative_optima.scale, scale, (10.0, 0.7)),
}


@pytest.mark.parametrize("case", CLOSED)
def test_price_is_that_of_the_published_closed_forms(case):
    build, oracle, settings = CLOSED[case]
    price = pc.price_of_stability(build(*settings)[0], starts=4)
    decisions, cost = oracle(*settings)
    for name, decision in zip(("naive", "stable", "optimal"), decisions, strict=True):
        assert_close(getattr(price, name), [[[decision]]], 1e-8)
        assert_close(getattr(price, f"cost_{name}"), cost(decision), 1e-10)
    naive, stable, optimal = map(cost, decisions)
    assert_close([price.ratio, price.ratio_naive], [stable / optimal, naive / optimal], 1e-10)
    assert_close([price.excess_stable, price.excess_naive], [stable - optimal, naive - optimal], 1e-9)


def test_paragraph_says_which_policy_is_cheaper_and_what_foresight_saves():
    saves = pc.price_of_stability(performative_optima.pricing(3.0, 0.8)[0], starts=4)
    assert saves.cost_naive > saves.cost_stable
    for words in ("more than the stable one: retraining lowers the cost", "not proved", "price of stability is 1.235"):
        assert words in str(saves)
    harms = pc.price_of_stability(performative_optima.location(10.0, 0.4, 0.5)[0], starts=4)
    assert harms.cost_naive < harms.cost_stable
    for words in ("less than the stable one: retraining raises the cost", f"save {harms.excess_stable:.4g}"):
        assert words in str(harms)


# --- enumeration with outer solvers ----------------------------------------------------------------------------------


def _deviation(M):
    return 0.1 + 3.0 * M**2


def _enumerated(M, deployed):
    """x ← 0.6 x + u + Δ x + w over three steps, u = -0.2 x + M w_{t-1}, on every path."""
    T, one = 3, np.ones((1, 1))
    spread = _deviation(deployed) * one
    return enumerate_cost(
        **{"A": np.broadcast_to(0.6 * one, (T, 1, 1)), "B": np.broadcast_to(one, (T, 1, 1))},
        **{"K": np.broadcast_to(0.2 * one, (T + 1, 1, 1)), "Q": np.broadcast_to(one, (T + 1, 1, 1))},
        **{"R": np.broadcast_to(0.3 * one, (T + 1, 1, 1)), "M": np.full((1, 1, 1), M)},
        noise=[(np.array([[1.0], [-1.0]]), np.full(2, 0.5))] * T,
        perturbations=[(np.stack([spread, -spread]), np.full(2, 0.5))] * T,
        initial=(np.array([[1.0]]), np.array([1.0])),
    )[0]


def _response(deployed):
    """The vertex of a parabola: what M costs in a given world is quadratic."""
    left, middle, right = (_enumerated(M, deployed) for M in (-1.0, 0.0, 1.0))
    return (left - right) / (2 * (left - 2 * middle + right))


@pytest.fixture(scope="module")
def enumerable():
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.6]], [[1.0]]),
        horizon=3,
        noise=pc.Rademacher([1.0]),
        cost=pc.QuadraticCost([[1.0]], [[0.3]]),
        gain=[[0.2]],
        perturbation=pc.DirectionalPerturbation([[[1.0]]], pc.Norm([0.1], [3.0], squared=True)),
        initial_state=[1.0],
    )


@pytest.mark.parametrize("before", [None, 0.9])
def test_three_policies_are_those_of_outer_solvers_on_the_enumerated_cost(enumerable, before):
    price = pc.price_of_stability(
        enumerable, deployed_before=None if before is None else np.full((1, 1, 1), before), starts=4
    )
    naive = stable = _response(before or 0.0)
    for _ in range(40):
        stable = _response(stable)
    optimal = scipy.optimize.minimize_scalar(lambda M: _enumerated(M, M), bounds=(-3, 3), method="bounded").x
    assert abs(naive - stable) > 1e-3 and abs(optimal - stable) > 1e-2
    assert_close([price.naive.item(), price.stable.item(), price.optimal.item()], [naive, stable, optimal], 1e-5)
    expected = [_enumerated(M, M) for M in (naive, stable, optimal)]
    assert_close([price.cost_naive, price.cost_stable, price.cost_optimal], expected, 1e-9)


def test_proved_interval_holds_the_price_of_a_dense_grid_of_enumerated_costs(enumerable):
    price = pc.price_of_stability(enumerable, starts=4, gap=1e-4)
    grid = [_enumerated(M, M) for M in np.linspace(-1.0, 1.0, 2001)]
    assert price.bound is not None and price.bound.lower <= min(grid) <= price.cost_optimal * (1 + 1e-6)
    low, high = price.ratio_bound
    assert low == price.ratio <= price.cost_stable / min(grid) * (1 + 1e-6) and high <= low * (1 + 2e-4)
    assert high == pytest.approx(price.cost_stable / price.bound.lower, rel=1e-14) and high > low
    assert f"No policy costs less than {price.bound.lower:.6g} (proved)" in str(price)


def test_without_a_gap_nothing_is_proved_and_that_is_said(enumerable):
    price = pc.price_of_stability(enumerable, starts=4, gap=None)
    assert price.bound is None and price.ratio_bound is None
    assert "was not looked into" in str(price)


@pytest.mark.parametrize(("ratio", "text"), [(1.0, "1"), (1.2346, "1.235"), (1.0004321, "1.00043"), (7.626, "7.626")])
def test_ratios_show_what_is_above_one(ratio, text):
    assert in_figures(ratio) == text


def test_cheaper_policy_of_the_bound_is_the_optimal_one(enumerable, monkeypatch):
    found = pc.price_of_stability(enumerable, starts=4)
    poor = pc.solve(enumerable, pc.StablePoint())  # as if descent had ended at the stable policy
    monkeypatch.setattr(price_module, "solve", lambda problem, solver, start, throw: poor)
    again = pc.price_of_stability(enumerable, starts=4)
    assert_close(again.optimal, found.optimal, 1e-6)
    assert again.cost_optimal == again.bound.upper < again.cost_stable - 0.1


def test_after_the_stable_policy_the_naive_one_is_the_stable_one(enumerable):
    stable = pc.solve(enumerable, pc.StablePoint()).M
    price = pc.price_of_stability(enumerable, deployed_before=stable, starts=4)
    assert_close(price.naive, price.stable, 1e-10)
    assert "costs the same as the stable one" in str(price)


# --- what always holds -----------------------------------------------------------------------------------------------


@pytest.mark.float32
def test_optimal_policy_is_never_dearer_and_costs_are_those_of_the_policies():
    for seed in range(4):
        problem = random_problem(seed, strength=1.0)
        price = pc.price_of_stability(problem, starts=4)
        assert price.cost_optimal <= min(price.cost_stable, price.cost_naive) and price.ratio >= 1
        for name in ("naive", "stable", "optimal"):
            cost = pc.expected_cost(problem, getattr(price, name))
            assert_close(cost, getattr(price, f"cost_{name}"), 1e-12, 1e-4)
        assert price.optimal.dtype == np.float64


def test_a_world_that_does_not_react_has_no_price():
    quiet = random_problem(0, strength=0.0)
    price = pc.price_of_stability(quiet, starts=4)
    assert price.ratio == pytest.approx(1.0, abs=1e-12) and price.excess_stable < 1e-9
    assert "foresight would save nothing" in str(price) and "the same as the stable one" in str(price)


def test_naive_policy_that_makes_an_unstable_world_has_no_cost():
    """On an infinite horizon: the first response lies in the turbulent belt, the stable policy beyond it."""
    naive = float(belt_response(0.0))
    assert HEIGHT * np.exp(-(((naive - CENTRE) / WIDTH) ** 2)) > 1 - F**2
    price = pc.price_of_stability(belt(), starts=4)
    assert price.cost_naive is None and price.ratio_naive is None and price.excess_naive is None
    assert_close(price.naive, [[[naive]]], 1e-9)
    assert "not mean-square stable" in str(price) and price.cost_stable > price.cost_optimal


def test_search_that_had_not_ended_is_said_and_only_then(enumerable):
    price = pc.price_of_stability(enumerable, starts=4)
    assert price.residual < 1e-11 and price.unique
    assert "had not ended" not in str(price)
    assert "had not ended" in str(dataclasses.replace(price, residual=1e-3))


# --- refusals --------------------------------------------------------------------------------------------------------


def test_what_has_no_price_is_refused_with_a_remedy():
    none = prediction_problem(1.0)  # Φ(θ) = 10 + θ
    assert_refused(lambda: pc.price_of_stability(none, starts=4), "problem", "stable policy", "PerformativeOptimum")
    ball = random_problem(0, bounded=True)
    far = 100 * np.ones(ball.policy_shape)
    assert_refused(lambda: pc.price_of_stability(ball, deployed_before=far), "deployed_before", "feasible set")
    convex = pc.PerformativeProblem(
        system=ball.system, horizon=5, noise=ball.noise, cost=pc.ConvexCost(lambda t, x, u: jnp.sum(x**2))
    )
    assert_refused(lambda: pc.price_of_stability(convex), "cost")
    drawn = pc.SampledPerturbation(lambda key, M: jax.random.normal(key, (5, 2, 2)))
    sampled = pc.PerformativeProblem(
        system=ball.system, horizon=5, noise=ball.noise, cost=ball.cost, perturbation=drawn
    )
    assert_refused(lambda: pc.price_of_stability(sampled), "perturbation")
