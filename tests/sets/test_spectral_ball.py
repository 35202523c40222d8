import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.sets.spectral_ball import clip_singular_values
from tests.contracts.feasible_set import SetContract
from tests.tools import assert_close, assert_refused, normal


class TestSpectralBall(SetContract):
    def feasible_set(self):
        return pc.SpectralBall(1.2)

    def constraints(self, M):
        return [cp.sigma_max(cp.hstack(M)) <= 1.2]


class TestSpectralBallOfTallMatrices(TestSpectralBall):
    """More inputs than columns of the stacked matrix."""

    shape = (1, 4, 2)


@pytest.mark.float32
def test_spectral_ball_clips_the_singular_values_of_the_lags_side_by_side():
    M = normal(1, 3, 2, 4)
    U, s, Vt = np.linalg.svd(np.concatenate(list(M), axis=1), full_matrices=False)
    limit = float(s.mean())
    expected = np.stack(np.split(U @ np.diag(np.minimum(s, limit)) @ Vt, 3, axis=1))
    assert_close(pc.SpectralBall(limit).project(M), expected, 1e-13, 1e-5)


def test_spectral_ball_under_repeated_blocks_bounds_the_full_policy_alike():
    structure, M = pc.RepeatedBlock(2), normal(2, 2, 2, 3)

    def stacked_norm(M):
        return np.linalg.norm(np.concatenate(list(np.asarray(M)), axis=1), 2)

    assert_close(stacked_norm(structure.lift(M)), stacked_norm(M))


def orthogonal(seed, size):
    return jnp.linalg.qr(normal(seed, size, size))[0]


@pytest.mark.parametrize(
    "values", [(2.0, 2.0, 2.0), (2.0, 2.0, 0.5), (3.0, 0.4, 0.4), (2.0, 0.0, 0.0), (0.5, 0.5, 0.2), (0.0, 0.0, 0.0)]
)
def test_spectral_projection_derivative_matches_differences_where_singular_values_meet(values):
    """Away from the limit 1 the projection is smooth even where the SVD is not."""
    X = orthogonal(1, 3) @ jnp.diag(jnp.asarray(values)) @ orthogonal(2, 5)[:3]
    V, step = normal(3, 3, 5), 1e-6
    limit = jnp.asarray(1.0)
    slope = jax.jvp(lambda X: clip_singular_values(X, limit), (X,), (V,))[1]
    difference = clip_singular_values(X + step * V, limit) - clip_singular_values(X - step * V, limit)
    np.testing.assert_allclose(slope, difference / (2 * step), atol=1e-7)


def test_spectral_projection_derivative_is_a_symmetric_contraction_on_its_kink():
    """At singular values equal to the limit any generalised derivative will do: symmetric, between 0 and 1."""
    X = orthogonal(1, 3) @ jnp.diag(jnp.asarray([1.0, 1.0, 0.3])) @ orthogonal(2, 4)[:3]
    J = jax.jacfwd(lambda x: clip_singular_values(x.reshape(3, 4), jnp.asarray(1.0)).reshape(-1))(X.reshape(-1))
    assert_close(J, J.T, 1e-12)
    values = np.linalg.eigvalsh((J + J.T) / 2)
    assert values.min() >= -1e-12 and values.max() <= 1 + 1e-12


def test_spectral_projection_differentiates_in_its_radius_both_ways():
    M, step = 3 * normal(4, 2, 2, 3), 1e-6

    def moved(radius):
        return jnp.sum(pc.SpectralBall(radius).project(M) * M)

    difference = (moved(1.0 + step) - moved(1.0 - step)) / (2 * step)
    assert_close(jax.jit(jax.grad(moved))(1.0), difference, 1e-8)
    assert_close(jax.jacfwd(moved)(1.0), difference, 1e-8)


REFUSED = {
    "negative": (lambda: pc.SpectralBall(-0.5), "radius", "empty", "-0.5"),
    "vector": (lambda: pc.SpectralBall([1.0, 2.0]), "radius", "(2,)"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_spectral_ball_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
