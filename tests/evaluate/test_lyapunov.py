"""X = W + 𝒯(X) and ρ(𝒯) against dense Kronecker matrices, and where no answer is given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from perfcontrol.evaluate import lyapunov
from tests.tools import assert_close, normal, random_psd

n = 4
F, D = 0.35 * normal(1, n, n), 0.2 * normal(2, 2, n, n)


def operator(X):
    return F.T @ X @ F + sum(d.T @ X @ d for d in D)


DENSE = np.kron(F.T, F.T) + sum(np.kron(d.T, d.T) for d in np.asarray(D))


@pytest.mark.float32
@pytest.mark.parametrize("size", [0, 24])
def test_solution_and_its_derivative_match_kronecker_products(size, monkeypatch):
    monkeypatch.setattr(lyapunov, "DENSE", size)  # 0: the series
    right = random_psd(3, n, 2)
    inverse = np.linalg.inv(np.eye(n * n) - DENSE)
    expected = (np.asarray(right).reshape(2, -1) @ inverse.T).reshape(2, n, n)
    assert_close(lyapunov.solve_fixed_point(operator, right), expected, 1e-12, 1e-4)
    weight = normal(4, 2, n, n)
    slope = jax.grad(lambda W: jnp.sum(weight * lyapunov.solve_fixed_point(operator, (W + W.mT) / 2)))(right)
    by_hand = (np.asarray(weight).reshape(2, -1) @ inverse).reshape(2, n, n)
    assert_close(slope, (by_hand + by_hand.swapaxes(1, 2)) / 2, 1e-11, 1e-4)


@pytest.mark.float32
def test_spectral_radius_matches_eigenvalues_of_the_kronecker_matrix():
    expected = np.abs(np.linalg.eigvals(DENSE)).max()
    assert_close(lyapunov.spectral_radius(operator, n, F.dtype), expected, 1e-10, 1e-4)
    assert lyapunov.spectral_radius(lambda X: 0 * X, n, F.dtype) == 0


def test_stability_is_decided_on_both_sides_of_one_and_not_within_rounding():
    right = jnp.eye(n)[None]
    radius = np.abs(np.linalg.eigvals(DENSE)).max()
    for scale, stable in ((0.999999, True), (1.000001, False), (3.0, False)):
        solution = lyapunov.solve_fixed_point(lambda X, s=scale: s / radius * operator(X), right)[0]
        assert bool(lyapunov.is_stable(solution)) is stable
    assert not lyapunov.is_stable(1e15 * jnp.eye(n))  # 1 - ρ is rounding
    assert not lyapunov.is_stable(jnp.full((n, n), jnp.nan))


def test_series_that_does_not_end_in_time_gives_no_number(monkeypatch):
    monkeypatch.setattr(lyapunov, "DENSE", 0)
    monkeypatch.setattr(lyapunov, "SERIES", 10)
    assert jnp.all(jnp.isnan(lyapunov.solve_fixed_point(lambda X: 0.99 * X, jnp.eye(n)[None])))
    monkeypatch.setattr(lyapunov, "SERIES", 5000)
    assert_close(lyapunov.solve_fixed_point(lambda X: 0.99 * X, jnp.eye(n)[None])[0], 100 * np.eye(n), 1e-10)
    assert jnp.all(jnp.isnan(lyapunov.solve_fixed_point(lambda X: 1.1 * X, jnp.eye(n)[None])))
