"""What every stage cost must do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tools import assert_close, assert_refused, central_differences, normal


class CostContract:
    """Inherit and define `cost`, fit for the sizes below."""

    state_size, input_size, horizon = 3, 2, 4
    difference_tolerance = 1e-7  # of central differences

    def cost(self):
        """The cost under test."""
        raise NotImplementedError

    def path(self, seed: int = 1) -> tuple[jax.Array, jax.Array]:
        """States and inputs of an arbitrary path."""
        length = self.horizon + 1
        return normal(seed, length, self.state_size), normal(seed + 1, length, self.input_size)

    def test_cost_and_gradients_have_one_entry_a_stage(self):
        cost = self.cost()
        cost.check(self.state_size, self.input_size, self.horizon)
        x, u = self.path()
        assert cost.path_cost(x, u).shape == (self.horizon + 1,)
        by_state, by_input = cost.path_gradients(x, u)
        assert by_state.shape == x.shape and by_input.shape == u.shape

    @pytest.mark.float32
    def test_gradients_match_automatic_differentiation(self):
        cost = self.cost()
        x, u = self.path()
        expected = jax.grad(lambda x, u: jnp.sum(cost.path_cost(x, u)), argnums=(0, 1))(x, u)
        for value, reference in zip(cost.path_gradients(x, u), expected, strict=True):
            assert_close(value, reference, 1e-12, 1e-5)

    def test_gradients_match_central_differences(self):
        cost = self.cost()
        x, u = self.path()
        total = jax.jit(lambda x, u: jnp.sum(cost.path_cost(x, u)))
        by_state = central_differences(lambda x: total(jnp.asarray(x), u), x, step=1e-5)
        by_input = central_differences(lambda u: total(x, jnp.asarray(u)), u, step=1e-5)
        for value, reference in zip(cost.path_gradients(x, u), (by_state, by_input), strict=True):
            assert_close(value, reference, self.difference_tolerance)

    def test_stage_cost_depends_on_its_own_stage_alone(self):
        cost = self.cost()
        x, u = self.path()
        base = cost.path_cost(x, u)
        moved = cost.path_cost(x.at[2].add(1.0), u.at[2].add(-1.0))
        assert_close(jnp.delete(moved, 2), jnp.delete(base, 2), 0, 0)
        assert moved[2] != base[2]

    def test_cost_is_convex_on_random_segments(self):
        cost = self.cost()
        x, u = self.path()
        for seed in range(5):
            y, v = (3.0 * part for part in self.path(seed + 10))
            middle = cost.path_cost((x + y) / 2, (u + v) / 2)
            ends = (cost.path_cost(x, u) + cost.path_cost(y, v)) / 2
            assert bool(jnp.all(middle <= ends + 1e-10 * (1 + jnp.abs(ends))))

    def test_quadratic_form_equals_the_path_cost_where_there_is_one(self):
        cost = self.cost()
        if not hasattr(cost, "form"):
            pytest.skip("not a quadratic cost")
        x, u = self.path()
        form = cost.form(self.horizon)
        z = np.concatenate([x, u], axis=1)
        expected = np.einsum("ti,tij,tj->t", z, form.matrix, z) + 2 * np.einsum("ti,ti->t", form.linear, z)
        assert_close(cost.path_cost(x, u), expected + np.asarray(form.constant), 1e-12)


class SizedCostContract(CostContract):
    """For costs that know their sizes: misfits are refused."""

    def test_misfit_of_the_state_size_is_refused(self):
        cost = self.cost()
        assert_refused(lambda: cost.check(self.state_size + 1, self.input_size, self.horizon), "Q", "shape")

    def test_misfit_of_the_input_size_is_refused(self):
        cost = self.cost()
        assert_refused(lambda: cost.check(self.state_size, self.input_size + 1, self.horizon), "R", "shape")
