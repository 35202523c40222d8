"""Orders of the sensitivities, by the bound and by the problem."""

import itertools

import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory import order_by_bound
from perfcontrol.theory.rates.orders import compare_orders
from tests.theory.problems import order_problem


def test_the_papers_weights_always_fall_in_time_and_the_rigorous_ones_need_not():
    """ν_t does not depend on k in the paper; with x_0 = 0 the rigorous ν_{t,k} is smallest for the first steps."""
    problem = order_problem(np.full(4, 1e-3))
    assert np.all(np.diff(pc.certify(problem, "paper").weights) < 0)
    rigorous = pc.certify(problem, "rigorous").weights
    assert rigorous[0] == min(rigorous)


def test_order_by_bound_is_the_best_of_all_permutations():

    epsilon, weights = [0.1, 0.5, 0.2, 0.9], [3.0, 1.0, 2.0, 0.5]
    sums = [np.dot(p, weights) for p in itertools.permutations(epsilon)]
    verdict = order_by_bound(epsilon, weights)
    assert verdict.best_value == pytest.approx(min(sums)) and verdict.worst_value == pytest.approx(max(sums))
    assert verdict.best @ np.array(weights) == pytest.approx(min(sums))


def test_small_early_sensitivities_are_preferred_by_the_bound_and_not_always_by_the_problem():
    epsilon = np.array([0.01, 0.02, 0.3, 0.4])
    weights = pc.certify(order_problem(epsilon), "paper").weights
    np.testing.assert_allclose(order_by_bound(epsilon, weights).best, np.sort(epsilon))
    rows = compare_orders(order_problem, epsilon, orders=[[0, 1, 2, 3], [3, 2, 1, 0], [2, 3, 0, 1]])
    # Δ_0 and Δ_1 act on states that the policy has not reached: the exact rate is smallest with the large ones there.
    assert rows[0]["order"].tolist() in ([3, 2, 1, 0], [2, 3, 0, 1])
    assert rows[-1]["order"].tolist() == [0, 1, 2, 3]
    with pytest.raises(pc.InputError, match="permutations"):
        compare_orders(order_problem, epsilon, orders=[[0, 0, 1, 2]])
