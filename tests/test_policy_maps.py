"""How a quantity depends on the policy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.policy_maps import ConstantMap, as_policy_map, evaluate_map
from perfcontrol.sets import LiftedSet
from tests.contracts.policy_map import PolicyMapContract
from tests.tools import assert_close, assert_refused, normal

M = normal(1, 2, 3, 4)


class TestConstantMap(PolicyMapContract):
    def policy_map(self):
        return ConstantMap(normal(11, 2, 3))


class TestAffine(PolicyMapContract):
    def policy_map(self):
        return pc.Affine(normal(12, 2, 3), normal(13, 2, 3, 2, 2, 4))


class TestNorm(PolicyMapContract):
    """Of all signs, about a policy outside the sets."""

    def policy_map(self):
        return pc.Norm(normal(14, 2, 3), normal(15, 3), center=0.4 * normal(16, 2, 2, 4))


class TestNormAboutZero(PolicyMapContract):
    def policy_map(self):
        return pc.Norm([[0.5, -0.2, 0.0]], [[2.0, -1.0, -3.0]])


class TestSquaredNorm(PolicyMapContract):
    def policy_map(self):
        return pc.Norm([[1.0], [-0.2]], [[-2.0], [0.5]], center=0.05 * normal(16, 2, 2, 4), squared=True)


class TestFunction(PolicyMapContract):
    knows = ()

    def policy_map(self):
        return pc.Function(lambda M, p: p * jnp.sum(jnp.tanh(M)) * jnp.ones((2, 3)), 0.3)


class TestFunctionDeclaredConvex(PolicyMapContract):
    knows = ()

    def policy_map(self):
        return pc.Function(lambda M: jnp.exp(jnp.sum(M[0])) * jnp.ones((1, 2)), convex=True)


@pytest.mark.float32
def test_affine_is_offset_plus_inner_product():
    offset, slope = normal(2, 5, 2), normal(3, 5, 2, 2, 3, 4)
    expected = np.asarray(offset) + np.einsum("tkimn,imn->tk", slope, M)
    assert_close(pc.Affine(offset, slope)(M), expected, 1e-13, 1e-5)
    assert_close(jax.jacobian(pc.Affine(offset, slope))(M), slope, 0, 0)


def test_affine_scalar_offset_takes_one_slope():
    assert_close(pc.Affine(1.0, np.ones((2, 3, 4)))(M), 1 + np.sum(M))


def test_function_receives_its_params_as_leaves():
    policy_map = pc.Function(lambda M, p: p["a"] * jnp.sum(M) + p["b"], {"a": 2, "b": np.array([1, 0])})
    assert_close(policy_map(M), 2 * np.sum(M) + np.array([1.0, 0.0]))
    assert len(jax.tree.leaves(policy_map)) == 2
    assert_close(pc.Function(jnp.sum)(M), np.sum(M))


def test_function_params_sweep_without_recompiling():
    traced = []

    def f(M, p):
        traced.append(1)
        return p * M[0, 0, 0]

    run = jax.jit(lambda policy_map: policy_map(M))
    values = [float(run(pc.Function(f, p))) for p in (1.0, 2.0, 3.0)]
    assert len(traced) == 1
    assert_close(values, np.array([1.0, 2.0, 3.0]) * float(M[0, 0, 0]))


def test_plain_callables_and_arrays_become_maps_and_constants():
    assert isinstance(as_policy_map("scale", jnp.sum), pc.Function)
    assert_close(evaluate_map(as_policy_map("scale", [1, 2]), M), [1.0, 2.0])
    affine = pc.Affine(1.0, np.ones((1, 1, 1)))
    assert as_policy_map("scale", affine) is affine


@pytest.mark.float32
@pytest.mark.parametrize("squared", [False, True])
def test_norm_is_the_weighted_distance_from_its_center(squared):
    offset, weight, center = normal(21, 5, 1), normal(22, 2), normal(23, 2, 3, 4)
    distance = np.linalg.norm(np.asarray(M - center)) ** (2 if squared else 1)
    value = pc.Norm(offset, weight, center, squared)(M)
    assert_close(value, np.asarray(offset) + np.asarray(weight) * distance, 1e-13, 1e-5)
    assert_close(pc.Norm(0.0, 1.0, squared=squared)(M), pc.Norm(0.0, 1.0, 0 * M, squared)(M), 0, 0)


@pytest.mark.float32
@pytest.mark.parametrize("squared", [False, True])
def test_norm_has_gradient_zero_at_its_center_and_a_unit_one_beside_it(squared):
    def gradient(center, policy):
        return jax.grad(pc.Norm(2.0, 3.0, center, squared))(policy)

    beside = M.at[0, 1, 2].add(1e-3)
    both = jax.jit(jax.vmap(gradient, (None, 0)))(M, jnp.stack([M, beside]))
    assert_close(both[0], jnp.zeros_like(M), 0, 0)
    assert_close(both[1], jnp.zeros_like(M).at[0, 1, 2].set(3.0 * (2e-3 if squared else 1)), 1e-9, 1e-3)
    assert_close(gradient(M, M), both[0], 0, 0)
    assert bool(jnp.all(jnp.isfinite(jax.hessian(pc.Norm(2.0, 3.0, M, squared))(M))))


def test_squared_norm_on_an_unbounded_set_knows_neither_range_nor_lipschitz_constant():
    wide = LiftedSet(pc.RowSum(1.0), pc.FullStructure(), M.shape)
    squared, plain = pc.Norm(1.0, [2.0, -3.0], squared=True), pc.Norm(1.0, [2.0, -3.0])
    assert squared.range(wide) is None and squared.lipschitz(wide) is None and plain.range(wide) is None
    assert_close(plain.lipschitz(wide), [2.0, 3.0])


MAPS_REFUSED = {
    "weights of another length": (lambda: pc.Norm([1.0, 2.0], [1.0, 2.0, 3.0]), "weight", "(3,)", "(2,)"),
    "center of two axes": (lambda: pc.Norm(0.0, 1.0, np.ones((2, 3))), "center", "(memory, input, state)"),
    "center of another policy": (lambda: pc.Norm(0.0, 1.0, M[:1])(M), "center", "(1, 3, 4)", "(2, 3, 4)"),
    "infinite weight": (lambda: pc.Norm(0.0, np.inf), "weight", "inf"),
    "slope of two axes": (lambda: pc.Affine(0.0, np.ones((2, 2))), "slope", "(2, 2)"),
    "slope and offset": (lambda: pc.Affine(np.zeros(3), np.ones((2, 1, 1, 1))), "slope", "(3,)"),
    "nan offset": (lambda: pc.Affine(np.nan, np.ones((1, 1, 1))), "offset", "nan"),
    "not callable": (lambda: pc.Function(3), "f", "callable"),
    "nan params": (lambda: pc.Function(lambda M, p: p, {"a": np.nan}), "params", "nan"),
    "scale of words": (lambda: as_policy_map("scale", "large"), "scale", "array of real numbers"),
}


@pytest.mark.parametrize("case", MAPS_REFUSED.values(), ids=MAPS_REFUSED.keys())
def test_policy_map_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
