"""Which method serves which problem, and where the only minimiser ends and one of many begins."""

import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.cost_to_go import world_of
from perfcontrol.response.projected import Projected
from perfcontrol.response.quadratic import Quadratic, factors, quadratic, stationary
from perfcontrol.response.respond import _method, _shape_of_cost
from tests.tools import DOUBLE, assert_close, normal


def problem(**changes):
    """Two states, three steps, noise with a mean."""
    system = pc.LinearSystem(0.4 * normal(0, 2, 2), normal(1, 2, 2))
    parts = {
        "system": system,
        "horizon": 3,
        "noise": pc.Rademacher([0.5, 0.8], mean=[0.1, -0.2]),
        "cost": pc.QuadraticCost(np.eye(2), np.eye(2)),
    }
    return pc.PerformativeProblem(**(parts | changes))


VARYING = pc.Sequence([[0.1, 0.2], [0.3, -0.1], [0.2, 0.4]])


@pytest.mark.parametrize(
    "changes, name",
    [
        ({}, "Separable"),
        ({"noise": VARYING}, "Affine"),
        ({"feasible_set": pc.RowSum(0.5)}, "Affine"),
        ({"feasible_set": pc.FrobeniusBall(0.5)}, "Projected"),
    ],
)
def test_the_cheapest_exact_method_serves(changes, name):
    p = problem(**changes)
    world = world_of(p, p.initial_policy())
    assert type(_method(p, world, _shape_of_cost(p, world))).__name__ == name
    assert stationary(world) == ("noise" not in changes)


def test_factors_and_matrix_are_the_same_quadratic():
    p = problem()
    M = normal(3, *p.policy_shape)
    world = world_of(p, M)
    assert_close(factors(p, world).gradient(np.asarray(M)), quadratic(p, world).gradient(M), 1e-12, 1e-4)


@pytest.mark.skipif(not DOUBLE, reason="curvatures below what single precision tells apart")
@pytest.mark.parametrize("curvature, unique", [(1.0, True), (1e-12, True), (1e-14, False), (0.0, False)])
def test_a_minimiser_is_the_only_one_while_its_least_curvature_is_above_rounding(curvature, unique):
    """The threshold is 100 p eps ‖𝐇‖: 4e-14 here."""
    form = Quadratic(jnp.asarray([[[-1.0, 0.0]]]), jnp.asarray(1.0), jnp.diag(jnp.asarray([1.0, curvature])))
    M, found = Projected(pc.FrobeniusBall(10.0), form).minimise(jnp.zeros((1, 1, 2)))
    assert bool(found) == unique
    assert_close(M, [[[1.0, 0.0]]], 1e-12)
