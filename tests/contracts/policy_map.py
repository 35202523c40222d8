"""What every policy map must do; what it says of a set is judged by a search over the set."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.policy_maps import AbstractPolicyMap, evaluate_map
from perfcontrol.sets import LiftedSet
from tests.tools import assert_close, normal, relative_error, tolerance

SETS = {
    "ball": (pc.FrobeniusBall(0.8), pc.FullStructure()),
    "simplex": (pc.RowSimplex(0.7), pc.FullStructure()),
    "blocks": (pc.FrobeniusBall(0.8), pc.RepeatedBlock(2)),
}
STARTS, LENGTHS = 12, 1e3 * 0.6 ** np.arange(32)  # of the search: its starts, and the lengths of its steps


class PolicyMapContract:
    """Inherit and define `policy_map`, with values of two axes for policies of `shape`; say what it knows."""

    shape = (2, 2, 4)  # of the lifted policy: (memory, input, state)
    knows: tuple[str, ...] = ("range", "lipschitz")  # the rest may be None
    sharp = ("ball", "simplex", "blocks")  # sets on which the range is exact

    def policy_map(self) -> AbstractPolicyMap:
        """The map under test."""
        raise NotImplementedError

    def lifted_set(self, name: str) -> LiftedSet:
        return LiftedSet(*SETS[name], self.shape)

    @classmethod
    @functools.cache
    def searched(cls, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Lifted policies of the set, random ones and those where projected steps up and down each entry end, and the
        map's values there, (N, *value)."""
        self, (feasible_set, structure) = cls(), SETS[name]
        policy_map, free = self.policy_map(), structure.free_shape(self.shape)
        count = evaluate_map(policy_map, jnp.zeros(self.shape)).size
        starts = normal(51, STARTS, *free) * jnp.linspace(0, 1.5, STARTS)[:, None, None, None] ** 3  # the first is 0
        entries, signs = jnp.arange(count), jnp.asarray([1.0, -1.0])

        def end(start, entry, sign):
            def value(theta):
                return sign * evaluate_map(policy_map, structure.lift(theta)).reshape(-1)[entry]

            def step(theta, length):
                slope = jax.grad(value)(theta)
                slope = slope / jnp.maximum(jnp.linalg.norm(slope), 1e-6)
                return feasible_set.project(theta + length * slope), None

            return jax.lax.scan(step, feasible_set.project(start), jnp.asarray(LENGTHS, start.dtype))[0]

        @jax.jit
        def everywhere(starts):
            search = jax.vmap(jax.vmap(jax.vmap(end, (None, None, 0)), (None, 0, None)), (0, None, None))
            ends = search(starts, entries, signs).reshape(-1, *free)
            points = jnp.concatenate([jax.vmap(feasible_set.project)(starts), ends])
            lifted = jax.vmap(structure.lift)(points)
            return lifted, jax.vmap(lambda M: evaluate_map(policy_map, M))(lifted)

        lifted, values = everywhere(starts)
        return np.asarray(lifted, dtype=float), np.asarray(values, dtype=float)

    def known(self, what: str, name: str):
        answer = getattr(self.policy_map(), what)(self.lifted_set(name))
        if answer is None:
            pytest.skip(f"{what} unknown")
        return answer

    def test_map_knows_what_it_claims_and_nothing_of_an_unbounded_set_that_is_not_finite(self):
        policy_map, wide = self.policy_map(), LiftedSet(pc.Unconstrained(), pc.FullStructure(), self.shape)
        value = policy_map(jnp.zeros(self.shape))
        for what in ("range", "lipschitz", "largest", "matrix_bound", "matrix_lipschitz"):
            assert what not in self.knows or getattr(policy_map, what)(self.lifted_set("ball")) is not None
            for leaf in jax.tree.leaves(getattr(policy_map, what)(wide)):
                assert bool(jnp.all(jnp.isfinite(leaf)))
                assert leaf.shape == (value.shape[:-2] if what.startswith("matrix") else value.shape)

    @pytest.mark.float32
    @pytest.mark.parametrize("name", SETS)
    def test_range_is_never_exceeded_and_reached_where_it_is_exact(self, name):
        low, high = self.known("range", name)
        _, values = self.searched(name)
        width = float(jnp.max(high - low))
        assert np.all(values >= low - tolerance(1e-12, 1e-5) * (1 + width))
        assert np.all(values <= high + tolerance(1e-12, 1e-5) * (1 + width))
        assert_close(self.known("largest", name), np.maximum(np.abs(low), np.abs(high)))
        if name in self.sharp:
            gap = np.maximum(values.min(axis=0) - low, high - values.max(axis=0))
            assert np.all(gap <= 1e-3 * width), f"{gap / width}"

    @pytest.mark.parametrize("name", SETS)
    def test_lipschitz_constants_are_never_exceeded_and_reached_on_the_ball(self, name):
        constants = self.known("lipschitz", name)
        policies, values = self.searched(name)
        distances = np.linalg.norm(
            (policies[:, None] - policies[None]).reshape(len(policies), len(policies), -1), axis=-1
        )
        apart = distances > 1e-6
        ratios = np.abs(values[:, None] - values[None])[apart] / distances[apart][:, None, None]
        assert np.all(ratios <= np.asarray(constants) * (1 + 1e-9) + 1e-9)
        if name == "ball":
            slopes = jax.vmap(jax.jacrev(self.policy_map()))(jnp.asarray(policies))
            steepest = jnp.max(jnp.linalg.norm(slopes.reshape(*values.shape, -1), axis=-1), axis=0)
            assert_close(steepest, constants, 1e-3)

    @pytest.mark.parametrize("name", SETS)
    def test_matrix_bound_and_constant_are_never_exceeded(self, name):
        bound, constant = self.known("matrix_bound", name), self.known("matrix_lipschitz", name)
        policies, values = self.searched(name)
        assert np.linalg.norm(values, ord=2, axis=(-2, -1)).max() <= float(bound) * (1 + 1e-12)
        weights = np.random.default_rng(1).uniform(0.5, 2, values.shape[1:])
        weighted = self.policy_map().matrix_lipschitz(self.lifted_set(name), jnp.asarray(weights))
        for i in range(0, len(policies), 7):
            moved = np.linalg.norm((policies - policies[i]).reshape(len(policies), -1), axis=1) + 1e-9
            for limit, factor in ((constant, 1.0), (weighted, weights)):
                ratios = np.linalg.norm(factor * (values - values[i]), axis=(-2, -1)) / moved
                assert ratios.max() <= float(limit) * (1 + 1e-9) + 1e-9

    @pytest.mark.float32
    def test_derivative_is_the_jacobian_at_every_policy_where_it_is_given(self):
        policy_map = self.policy_map()
        derivative = policy_map.derivative()
        if derivative is None:
            pytest.skip("no constant derivative")
        for M in (normal(1, *self.shape), 3 * normal(2, *self.shape)):
            assert_close(jax.jacrev(policy_map)(M), derivative, 1e-13, 1e-5)

    def test_jacobian_matches_central_differences(self):
        policy_map, M, V = self.policy_map(), normal(3, *self.shape), normal(4, *self.shape)
        ahead, behind = (np.asarray(policy_map(M + step * V)) for step in (1e-5, -1e-5))
        slope = jax.jvp(policy_map, (M,), (V,))[1]
        assert relative_error(slope, (ahead - behind) / 2e-5) <= 1e-8 or np.abs(ahead - behind).max() <= 1e-12

    def test_continuity_is_claimed_by_whoever_knows_a_lipschitz_constant(self):
        policy_map = self.policy_map()
        assert policy_map.continuous or policy_map.lipschitz(self.lifted_set("ball")) is None

    def test_constant_map_has_one_value(self):
        policy_map = self.policy_map()
        same = relative_error(policy_map(normal(5, *self.shape)), policy_map(normal(6, *self.shape))) == 0
        assert same or not policy_map.constant

    def test_sublevel_sets_are_convex_exactly_where_said(self):
        """Convex: no point of a segment lies above both its ends. Not convex: some midpoint does."""
        convex = self.policy_map().convex
        if convex is None:
            pytest.skip("not said")
        policies, values = self.searched("ball")
        ends = np.abs(values)
        value = jax.jit(jax.vmap(self.policy_map()))
        violated = False
        for i in range(0, len(policies), 5):
            middles = np.abs(np.asarray(value(jnp.asarray((policies + policies[i]) / 2))))
            violated |= bool(np.any(middles > np.maximum(ends, ends[i]) + 1e-9))
        assert violated != convex

    @pytest.mark.float32
    def test_map_is_a_pytree_that_jit_and_vmap_take(self):
        policy_map, M = self.policy_map(), normal(7, 3, *self.shape)
        singles = [policy_map(one) for one in M]
        assert_close(jax.jit(jax.vmap(policy_map))(M), jnp.stack(singles), 1e-13, 1e-5)
        stacked = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), policy_map)
        assert_close(eqx.filter_vmap(lambda f, one: f(one))(stacked, M), jnp.stack(singles), 1e-13, 1e-5)
        with pytest.raises(AttributeError):
            policy_map.extra = 1
