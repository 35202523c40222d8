"""Simulated paths: their dynamics, their law, their keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate import rollout
from perfcontrol.evaluate.paths import lanes
from tests.evaluate.cases import BUILDERS, SmoothCost, case, replaced
from tests.oracles.enumeration import Paths, simulate, stage_gradients
from tests.tools import assert_close, assert_refused, relative_error

KEY = jax.random.key(11)


def drawn_paths(trajectories) -> Paths:
    """What was drawn, for the oracle to drive."""
    dense = jax.vmap(lambda draws: draws.dense())(trajectories.draws)
    count = trajectories.x.shape[0]
    arrays = (np.asarray(part, dtype=float) for part in (trajectories.x[:, 0], trajectories.w, dense))
    return Paths(np.full(count, 1 / count), *arrays)


@pytest.mark.float32
@pytest.mark.parametrize("name", BUILDERS)
def test_simulated_paths_match_the_oracle_driven_by_the_same_draws(name):
    c = case(name)
    trajectories = pc.simulate(c.problem, c.M, deployed=c.deployed, key=KEY, samples=3)
    x, u, _, _ = simulate(**c.system(), M=np.asarray(c.problem.structure.lift(c.M)), paths=drawn_paths(trajectories))
    assert_close(trajectories.x, x, 1e-12, 1e-4)
    assert_close(trajectories.u, u, 1e-12, 1e-4)
    assert_close(trajectories.cost, stage_gradients(x, u, **c.cost())[0].sum(axis=1), 1e-12, 1e-4)


@pytest.mark.float32
@pytest.mark.parametrize("name", ["everything varies, performative B", "reweighted matrices", "repeated block"])
def test_estimated_cost_within_five_standard_errors_of_expected_cost(name):
    c = case(name)
    estimate = pc.estimate_cost(c.problem, c.M, deployed=c.deployed, key=KEY, samples=8000)
    exact = pc.expected_cost(c.problem, c.M, deployed=c.deployed)
    assert abs(float(estimate.mean - exact)) < 5 * float(estimate.standard_error)
    assert float(estimate.standard_error) < 0.05 * float(exact)


def test_estimate_is_mean_and_standard_error_of_simulated_costs():
    c = case("zero means")
    costs = pc.simulate(c.problem, c.M, deployed=c.deployed, key=KEY, samples=50).cost
    estimate = pc.estimate_cost(c.problem, c.M, deployed=c.deployed, key=KEY, samples=50)
    assert_close(estimate.mean, jnp.mean(costs))
    assert_close(estimate.standard_error, np.std(costs, ddof=1) / np.sqrt(50))


def test_same_key_gives_the_same_paths_and_more_samples_keep_the_first():
    c = case("zero means")
    fifty = pc.simulate(c.problem, c.M, deployed=c.deployed, key=KEY, samples=50)
    again = pc.simulate(c.problem, c.M, deployed=c.deployed, key=KEY, samples=50)
    three = pc.simulate(c.problem, c.M, deployed=c.deployed, key=KEY, samples=3)
    other = pc.simulate(c.problem, c.M, deployed=c.deployed, key=jax.random.key(12), samples=3)
    assert_close(again.x, fifty.x, 0, 0)
    assert_close(three.x, fifty.x[:3], 1e-14)
    assert_close(pc.simulate(c.problem, c.M, deployed=c.deployed, key=KEY).x, fifty.x[:1], 1e-14)
    assert relative_error(other.x, three.x) > 1e-2


def test_simulation_needs_no_quadratic_cost():
    c = case("zero means")
    problem = replaced(c.problem, cost=SmoothCost())
    trajectories = pc.simulate(problem, c.M, key=KEY, samples=3)
    expected = np.logaddexp(trajectories.x, -trajectories.x).sum(axis=(1, 2)) + np.sqrt(1 + trajectories.u**2).sum(
        axis=(1, 2)
    )
    assert_close(trajectories.cost, expected)


@pytest.mark.parametrize("function", [pc.simulate, pc.estimate_cost, pc.sample_gradient])
def test_simulation_refuses_bad_arguments(function):
    c = case("zero means")
    shape = c.problem.policy_shape
    assert_refused(lambda: function(c.problem, c.M), "key", "None", "jax.random.key(0)")
    assert_refused(lambda: function(c.problem, c.M, key=5), "key", "jax.random.key(5)")
    assert_refused(lambda: function(c.problem, c.M, key="seed"), "key", "str")
    assert_refused(lambda: function(c.problem, c.M, key=KEY, samples=0), "samples", "0")
    assert_refused(lambda: function(c.problem, c.M, key=KEY, samples=2.5), "samples", "integer")
    assert_refused(lambda: function(c.problem, np.swapaxes(c.M, 1, 2), key=KEY), "M", "swapped", str(shape))
    assert_refused(lambda: function(c.problem, c.M[0], key=KEY), "M", str(shape))
    assert_refused(lambda: function(c.problem, c.M, deployed=c.M.at[0, 0, 1].set(np.inf), key=KEY), "deployed", "inf")


def test_one_sample_is_too_few_for_a_standard_error():
    c = case("zero means")
    assert_refused(lambda: pc.estimate_cost(c.problem, c.M, key=KEY, samples=1), "samples", "at least 2")


def test_fewer_paths_are_worked_on_together_where_perturbations_are_large():
    def dense(n, T):
        return pc.PerformativeProblem(
            system=pc.LinearSystem(0.1 * np.eye(n), np.eye(n)),
            horizon=T,
            noise=pc.Rademacher(np.ones(n)),
            cost=pc.QuadraticCost(np.eye(n), np.eye(n)),
            perturbation=pc.DensePerturbation(0.1),
        )

    assert lanes(dense(4, 10)) == 4  # numbers of eight bytes
    assert lanes(dense(4, 16_000)) == 4  # 1.5 MB of states, inputs and noise, 2 MB of matrices
    assert lanes(dense(4, 32_000)) == 2
    assert lanes(dense(100, 10)) == 1  # matrices too large to lie side by side


def test_paths_that_do_not_fit_into_the_memory_are_refused_before_work_starts(monkeypatch):
    c = case("zero means")
    one = c.problem.horizon * 2 * 8  # bytes of one path's noise: less than those of the path
    monkeypatch.setattr(rollout, "memory_size", lambda: 10 * one)
    assert_refused(lambda: pc.simulate(c.problem, c.M, key=KEY, samples=40), "samples", "at most", "pc.estimate_cost")
    assert pc.simulate(c.problem, c.M, key=KEY, samples=2).x.shape[0] == 2
    monkeypatch.setattr(rollout, "memory_size", lambda: one)
    assert_refused(lambda: pc.simulate(c.problem, c.M, key=KEY), "samples", "Shorten the horizon")
    monkeypatch.setattr(rollout, "memory_size", lambda: None)
    assert pc.simulate(c.problem, c.M, key=KEY, samples=40).x.shape[0] == 40
