"""Which method serves which problem, and where the only minimiser ends and one of many begins."""

import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.world import world_of
from perfcontrol.response.methods import method_of, shape_of_cost
from perfcontrol.response.projected import Projected, ProjectedByFactors
from perfcontrol.response.quadratic import Factors, Quadratic, factors, quadratic, stationary
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
        ({"feasible_set": pc.FrobeniusBall(0.5)}, "ProjectedByFactors"),
        ({"feasible_set": pc.FrobeniusBall(0.5), "noise": VARYING}, "Projected"),
    ],
)
def test_the_cheapest_exact_method_serves(changes, name):
    p = problem(**changes)
    world = world_of(p, p.initial_policy())
    assert type(method_of(p, world, shape_of_cost(p, world))).__name__ == name
    assert stationary(world) == ("noise" not in changes)


@pytest.mark.parametrize("exponent, steps_end", [(1.0, True), (8.0, False)])
@pytest.mark.parametrize("definite", [True, False])
@pytest.mark.parametrize("name", ["ball", "box", "active ball", "active box"])
@pytest.mark.skipif(not DOUBLE, reason="conditions that single precision does not tell apart")
def test_gradient_steps_end_at_the_minimiser_or_hand_over_to_newton(name, exponent, steps_end, definite):
    """A quadratic whose minimiser, of norm 1, lies inside the set, or outside of it."""
    size = 0.7 if name.startswith("active") else 9.0
    feasible_set = pc.FrobeniusBall(size) if name.endswith("ball") else pc.Box(-size / 3, size / 3)
    vectors, _ = np.linalg.qr(normal(7, 6, 6))
    G, inside = (vectors * np.logspace(0, -exponent, 6)) @ vectors.T, np.asarray(normal(8, 3, 2, 2))
    inside = inside / np.linalg.norm(inside)
    linear = -2 * (G @ inside.reshape(6, 2)).reshape(3, 2, 2)
    form = Factors(linear, G, np.zeros((6, 6)), np.eye(2), np.zeros(2))
    newton = Projected(feasible_set, Quadratic(form.linear, np.asarray(0.5), form.matrix))
    asked = []
    method = ProjectedByFactors(
        feasible_set, form, np.asarray(0.5), np.asarray(definite), lambda: asked.append(None) or newton
    )
    M, unique = method.minimise(np.zeros_like(linear))
    reference, _ = newton.minimise(np.zeros_like(linear))
    assert_close(M, reference, 1e-7 if exponent > 1 else 1e-12)
    if not name.startswith("active"):
        assert_close(M, inside, 1e-7 if exponent > 1 else 1e-12)
        assert bool(asked) == (not steps_end or not definite)
    assert bool(unique)


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
