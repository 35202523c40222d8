import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.feasible_set import SetContract
from tests.tools import assert_close, assert_refused, normal

LOW, WIDTH = normal(1, 2, 2, 3), jnp.abs(normal(2, 2, 2, 3)).at[0, 1, 2].set(0.0)


class TestBoxOfNumbers(SetContract):
    def feasible_set(self):
        return pc.Box(-0.8, 0.3)

    def constraints(self, M):
        return [lag >= -0.8 for lag in M] + [lag <= 0.3 for lag in M]


class TestBoxOfArraysWithOneFixedEntry(SetContract):
    def feasible_set(self):
        return pc.Box(LOW, LOW + WIDTH)

    def constraints(self, M):
        low, high = np.asarray(LOW), np.asarray(LOW + WIDTH)
        return [lag >= low[i] for i, lag in enumerate(M)] + [lag <= high[i] for i, lag in enumerate(M)]


class TestNonnegativeOrthant(SetContract):
    def feasible_set(self):
        return pc.Box(0, np.inf)

    def constraints(self, M):
        return [lag >= 0 for lag in M]


def test_box_projection_is_numpy_clip():
    M = 3 * normal(3, 2, 2, 3)
    assert_close(pc.Box(LOW, 0.5 + LOW).project(M), np.clip(M, LOW, 0.5 + LOW), 0, 0)


def test_box_keeps_fixed_entries_out_of_the_derivative():
    slope = jax.jacfwd(pc.Box([[[1.0, 0.0]]], [[[1.0, 2.0]]]).project)(jnp.asarray([[[1.0, 1.0]]]))
    assert_close(slope.reshape(2, 2), np.diag([0.0, 1.0]), 0, 0)


def test_box_support_and_radius_of_traced_bounds_are_the_same():
    direction = normal(4, 2, 2, 3)
    eager = pc.Box(LOW, LOW + 1)

    def both(low):
        box = pc.Box(low, low + 1)
        return box.support(direction), box.radius((2, 2, 3))

    assert_close(jnp.stack(jax.jit(both)(LOW)), [eager.support(direction), eager.radius((2, 2, 3))], 1e-13)


REFUSED = {
    "crossed": (lambda: pc.Box(1.0, 0.5), "low", "empty", "0.5"),
    "nan": (lambda: pc.Box(np.nan, 1.0), "low", "finite"),
    "misfit of each other": (lambda: pc.Box(np.zeros((1, 2, 3)), np.ones((1, 3, 2))), "low", "(1, 2, 3)"),
    "misfit of the policy": (
        lambda: pc.Box(0.0, np.ones((1, 2, 3))).check((1, 2, 2)),
        "high",
        "(1, 2, 3)",
        "(1, 2, 2)",
    ),
    "words": (lambda: pc.Box("a", 1.0), "low", "real numbers"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_box_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
