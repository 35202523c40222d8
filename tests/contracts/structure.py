"""What every linear structure of the policy must do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.tools import assert_close, normal


class StructureContract:
    """Inherit and define `structure`; `shape` is that of the full policy."""

    shape = (2, 4, 6)  # (memory, input, state)

    def structure(self):
        """The structure under test."""
        raise NotImplementedError

    @pytest.mark.float32
    def test_lift_has_the_policy_shape_and_is_linear(self):
        structure = self.structure()
        free = structure.free_shape(self.shape)
        one, two = normal(1, *free), normal(2, *free)
        assert structure.lift(one).shape == self.shape
        combined = structure.lift(2 * one - 3 * two)
        assert_close(combined, 2 * structure.lift(one) - 3 * structure.lift(two), 1e-13, 1e-5)

    @pytest.mark.float32
    def test_adjoint_is_the_adjoint_of_lift(self):
        structure = self.structure()
        theta, Y = normal(1, *structure.free_shape(self.shape)), normal(3, *self.shape)
        assert structure.adjoint(Y).shape == theta.shape
        assert_close(jnp.sum(structure.lift(theta) * Y), jnp.sum(theta * structure.adjoint(Y)), 1e-12, 1e-4)

    def test_product_matrix_is_that_of_the_product_between_lift_and_adjoint(self):
        structure, (H, m, n) = self.structure(), self.shape
        free = structure.free_shape(self.shape)
        left, right, theta = normal(4, H * m, H * m), normal(5, n, n), normal(6, *free)
        image = np.asarray(left) @ np.asarray(structure.lift(theta)).reshape(H * m, n) @ np.asarray(right)
        expected = np.asarray(structure.adjoint(jnp.asarray(image.reshape(H, m, n)))).reshape(-1)
        assert_close(structure.product_matrix(left, right, free) @ theta.reshape(-1), expected, 1e-12)

    def test_adjoint_after_lift_is_the_squared_norm(self):
        structure = self.structure()
        theta = normal(1, *structure.free_shape(self.shape))
        assert_close(structure.adjoint(structure.lift(theta)), structure.norm**2 * theta, 1e-13, 1e-5)

    def test_norm_is_the_largest_singular_value_of_the_lift(self):
        structure = self.structure()
        free = structure.free_shape(self.shape)
        basis = jnp.eye(int(np.prod(free))).reshape(-1, *free)
        matrix = np.asarray(jax.vmap(structure.lift)(basis)).reshape(len(basis), -1)
        singular_values = np.linalg.svd(matrix, compute_uv=False)
        assert singular_values.max() == pytest.approx(structure.norm, rel=1e-6)
        assert singular_values.min() > 0.5 * structure.norm, "the lift is not injective"
