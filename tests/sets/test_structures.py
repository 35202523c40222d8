import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.sets import LiftedSet
from tests.contracts.structure import StructureContract
from tests.tools import assert_close, assert_refused, normal


class TestFullStructure(StructureContract):
    def structure(self):
        return pc.FullStructure()


class TestRepeatedBlock(StructureContract):
    def structure(self):
        return pc.RepeatedBlock(2)


class TestRepeatedBlockOfThree(StructureContract):
    shape = (1, 3, 6)

    def structure(self):
        return pc.RepeatedBlock(3)


class Swapped(pc.AbstractStructure):
    """The block twice, the second time with its lags in the other order: nothing but what a structure must have."""

    def lift(self, parameters):
        return jnp.concatenate([parameters, parameters[::-1]], axis=1)

    def adjoint(self, M):
        first, second = jnp.split(M, 2, axis=1)
        return first + second[::-1]

    def free_shape(self, policy_shape):
        H, m, n = policy_shape
        return H, m // 2, n

    @property
    def norm(self):
        return float(np.sqrt(2))


class TestSwapped(StructureContract):
    def structure(self):
        return Swapped()


def test_repeated_block_lifts_to_a_block_diagonal():
    theta = normal(1, 2, 1, 2)
    lifted = pc.RepeatedBlock(2).lift(theta)
    for block, full in zip(np.asarray(theta), np.asarray(lifted), strict=True):
        assert_close(full, np.block([[block, np.zeros_like(block)], [np.zeros_like(block), block]]), 0, 0)


def test_lifted_set_support_is_the_supremum_over_lifted_policies():
    """<D, lift θ> = <adjoint D, θ>, so its supremum over a ball is radius ‖adjoint D‖, attained."""
    structure, ball = pc.RepeatedBlock(2), pc.FrobeniusBall(3.0)
    lifted_set = LiftedSet(ball, structure, (2, 4, 6))
    directions = normal(2, 5, 2, 4, 6)
    free = jax.vmap(structure.adjoint)(directions)
    best = jax.vmap(lambda D: structure.lift(3.0 * D / jnp.linalg.norm(D)))(free)
    support = lifted_set.support(directions)
    assert support.shape == (5,)
    assert_close(support, jnp.sum(best * directions, axis=(1, 2, 3)))
    assert_close(lifted_set.radius, jnp.linalg.norm(best[0]))
    assert_close(lifted_set.support(directions[0]), support[0])


def test_lifted_set_measures_from_any_policy_also_one_outside_the_structure():
    """‖lift θ - C‖ over a ball of θ: the part of C outside the structure, and √2 times that of θ from its free part."""
    structure, lifted_set = pc.RepeatedBlock(2), LiftedSet(pc.FrobeniusBall(0.5), pc.RepeatedBlock(2), (2, 4, 6))
    center = np.asarray(normal(3, 2, 4, 6))
    basis = np.asarray(jax.vmap(structure.lift)(jnp.eye(12).reshape(12, 2, 2, 3))).reshape(12, -1).T
    free, residual, *_ = np.linalg.lstsq(basis, center.reshape(-1), rcond=None)
    reach = np.linalg.norm(free)
    for value, inner in ((lifted_set.farthest, reach + 0.5), (lifted_set.distance, reach - 0.5)):
        assert_close(value(jnp.asarray(center)), np.sqrt(2 * inner**2 + residual[0]))


def test_lifted_set_of_an_unbounded_set_knows_no_radius_and_no_support():
    lifted_set = LiftedSet(pc.RowSum(1.0), pc.RepeatedBlock(2), (1, 4, 4))
    assert lifted_set.radius is None and lifted_set.support(normal(1, 1, 4, 4)) is None


STRUCTURES_REFUSED = {
    "blocks that do not divide": (lambda: pc.RepeatedBlock(2).free_shape((1, 3, 4)), "structure", "m, n = 3, 4"),
    "zero blocks": (lambda: pc.RepeatedBlock(0), "count", "at least 1"),
    "half a block": (lambda: pc.RepeatedBlock(1.5), "count", "integer"),
}


@pytest.mark.parametrize("case", STRUCTURES_REFUSED.values(), ids=STRUCTURES_REFUSED.keys())
def test_structure_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
