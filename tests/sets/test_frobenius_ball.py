import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.feasible_set import SetContract
from tests.tools import assert_close, assert_refused, normal


class TestFrobeniusBall(SetContract):
    def feasible_set(self):
        return pc.FrobeniusBall(2.0)

    def constraints(self, M):
        return [cp.norm(cp.vstack(M), "fro") <= 2.0]


class TestFrobeniusBallOfOnePoint(SetContract):
    differentiable = False

    def feasible_set(self):
        return pc.FrobeniusBall(0)

    def constraints(self, M):
        return [lag == 0 for lag in M]


@pytest.mark.float32
def test_frobenius_ball_projection_keeps_the_inside_and_scales_the_outside():
    M = normal(1, 2, 2, 3)
    unit = M / jnp.linalg.norm(M)
    ball = pc.FrobeniusBall(2.0)
    assert_close(ball.project(1.9 * unit), 1.9 * unit, 0, 0)
    assert_close(ball.project(5.0 * unit), 2.0 * unit, 1e-14, 1e-6)


def test_frobenius_ball_projection_differentiates_under_jit_in_its_radius():
    M = normal(1, 1, 2, 2)
    slope = jax.jit(jax.grad(lambda radius: jnp.sum(pc.FrobeniusBall(radius).project(M) * M)))(0.5)
    assert_close(slope, jnp.linalg.norm(M))


BALLS_REFUSED = {
    "negative": (lambda: pc.FrobeniusBall(-1.0), "radius", "empty", "-1.0"),
    "vector": (lambda: pc.FrobeniusBall([1.0, 2.0]), "radius", "(2,)"),
    "nan": (lambda: pc.FrobeniusBall(np.nan), "radius", "finite"),
}


@pytest.mark.parametrize("case", BALLS_REFUSED.values(), ids=BALLS_REFUSED.keys())
def test_frobenius_ball_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
