"""Discounted costs against enumeration with weights discounted by hand, and against simulation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.evaluate.cases import case, replaced
from tests.oracles.enumeration import enumerate_cost
from tests.tools import assert_close, assert_mean_is

DISCOUNT = 0.7


def discounted(name):
    """The case under a discount, and its enumerated cost and gradient."""
    c = case(name)
    cost = c.problem.cost
    parts = {part: getattr(cost, part) for part in ("Q", "R", "cross", "state_target", "input_target")}
    problem = replaced(c.problem, cost=pc.QuadraticCost(**parts, discount=DISCOUNT))
    factors = DISCOUNT ** np.arange(problem.horizon + 1)
    oracle = c.cost()
    for part in ("Q", "R", "cross"):
        if oracle[part] is not None:
            oracle[part] = factors[:, None, None] * oracle[part]
    lifted = np.asarray(problem.structure.lift(c.M))
    value, gradient = enumerate_cost(**c.system(), **oracle, M=lifted, **c.laws())
    gradient = np.asarray(problem.structure.adjoint(jnp.asarray(gradient)))
    return dataclasses.replace(c, problem=problem), value, gradient


@pytest.mark.float32
@pytest.mark.parametrize("name", ["scalar with every mean", "zero means", "everything varies, performative B"])
def test_discounted_cost_and_gradient_match_enumeration_of_every_path(name):
    c, value, gradient = discounted(name)
    assert_close(pc.expected_cost(c.problem, c.M, deployed=c.deployed), value, 1e-11, 1e-5)
    assert_close(pc.expected_gradient(c.problem, c.M, deployed=c.deployed), gradient, 1e-11, 1e-5)
    assert_close(pc.expected_cost_by_moments(c.problem, c.M, deployed=c.deployed), value, 1e-11, 1e-5)


def test_best_response_to_a_discounted_cost_is_stationary_by_the_enumerated_gradient():
    c, *_ = discounted("zero means")
    response = pc.best_response(c.problem, c.deployed)
    factors = DISCOUNT ** np.arange(c.problem.horizon + 1)
    oracle = c.cost()
    oracle["Q"], oracle["R"] = (factors[:, None, None] * oracle[part] for part in ("Q", "R"))
    _, gradient = enumerate_cost(**c.system(), **oracle, M=np.asarray(response), **c.laws())
    assert np.abs(gradient).max() < 1e-10
    assert float(jnp.linalg.norm(response - pc.best_response(case("zero means").problem, c.deployed))) > 1e-3


def test_simulated_discounted_cost_has_the_exact_mean_for_either_kind_of_cost():
    c, value, _ = discounted("zero means")
    cost = c.problem.cost
    assert isinstance(cost, pc.QuadraticCost)
    by_function = pc.ConvexCost(lambda t, x, u: x @ cost.Q @ x + u @ cost.R @ u, discount=DISCOUNT)
    same = replaced(c.problem, cost=by_function)
    key = jax.random.key(1)
    first, second = (pc.simulate(p, c.M, deployed=c.deployed, key=key, samples=4096).cost for p in (c.problem, same))
    assert_mean_is(first, value)
    assert_close(second, first)
    one, two = (pc.sample_gradient(p, c.M, deployed=c.deployed, key=key, samples=8) for p in (c.problem, same))
    assert_close(two, one, 1e-11)


def test_discount_may_be_swept_under_vmap():
    c, *_ = discounted("zero means")

    stage = c.problem.cost
    assert isinstance(stage, pc.QuadraticCost)

    def cost(discount):
        problem = replaced(c.problem, cost=pc.QuadraticCost(stage.Q, stage.R, discount=discount))
        return pc.expected_cost(problem, c.M, deployed=c.deployed)

    swept = jax.vmap(cost)(jnp.asarray([DISCOUNT, 1.0]))
    assert_close(swept[0], pc.expected_cost(c.problem, c.M, deployed=c.deployed))
    assert_close(swept[1], pc.expected_cost(case("zero means").problem, c.M, deployed=c.deployed))
