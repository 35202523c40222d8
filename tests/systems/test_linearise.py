"""Smooth maps near an equilibrium: derivatives against finite differences, errors against remainders known by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.tools import assert_close, assert_refused, normal, tolerance

KEY = jax.random.key(0)
A = np.array([[0.8, 0.3], [-0.1, 0.5]])
B = np.array([[1.0], [0.5]])


def saturating(x, u):
    """Equilibria are where x = 0.4 x + tanh-response(u): one for every input."""
    return 0.4 * x + jnp.tanh(jnp.array([0.5, -0.3]) * u[0] + jnp.array([0.1, 0.2]) * x[::-1])


def rest(f, u, steps=400):
    x = np.zeros(2)
    for _ in range(steps):
        x = np.asarray(f(jnp.asarray(x), jnp.asarray(u)))
    return x


def differences(f, point, step=1e-6):
    """Columns of the derivative by central differences."""
    point = np.asarray(point, dtype=float)
    moves = step * np.eye(len(point))
    return np.stack([(np.asarray(f(point + m)) - np.asarray(f(point - m))) / (2 * step) for m in moves], axis=1)


def test_derivatives_and_offset_match_finite_differences():
    u = np.array([0.7])
    x = rest(saturating, u)
    near = pc.linearise(saturating, x, u)
    assert_close(near.A, differences(lambda z: saturating(jnp.asarray(z), u), x), 1e-8)
    assert_close(near.B, differences(lambda v: saturating(x, jnp.asarray(v)), u), 1e-8)
    assert_close(near.offset, x - np.asarray(near.A) @ x - np.asarray(near.B) @ u, 1e-10)
    assert np.abs(near.residual).max() < 1e-12 and near.reaction is None
    assert isinstance(near.system, pc.LinearSystem)
    assert_close(near.system.A, near.A, 0)


@pytest.mark.float32
def test_linear_map_is_itself_and_has_no_error():
    w = np.array([0.3, -0.2])
    x = np.linalg.solve(np.eye(2) - A, B @ [0.4] + w)
    near = pc.linearise(lambda z, u: jnp.asarray(A) @ z + jnp.asarray(B) @ u + jnp.asarray(w), x, [0.4])
    assert_close(near.A, A)
    assert_close(near.B, B)
    assert_close(near.offset, w, 1e-12, 1e-4)
    error = near.error(3.0, key=KEY)
    assert error.largest < tolerance(1e-13, 1e-4) and error.relative < tolerance(1e-13, 1e-4)


def test_error_of_a_quadratic_is_its_remainder():
    """f = x/2 + u + x²: the remainder is (Z - Z̄)², at most r² on a ball of radius r, and r relative to the distance."""
    near = pc.linearise(lambda x, u: 0.5 * x + u + x**2, [0.2], [0.06])
    for radius in (0.5, 0.05):
        error = near.error(radius, key=KEY, samples=4000)
        assert 0.999 * radius**2 < error.largest <= radius**2 * (1 + 1e-9)
        assert 0.999 * radius < error.relative <= radius * (1 + 1e-9)
    flat = near.error([1e-4, 10.0], key=KEY)  # half-axes of their own: the input may move far, it is linear
    assert flat.largest <= 1e-8 * (1 + 1e-9) + 1e-13


def test_relative_error_halves_with_the_radius():
    x = rest(saturating, np.array([0.7]))
    near = pc.linearise(saturating, x, [0.7])
    errors = [near.error(radius, key=KEY).relative for radius in (0.02, 0.01, 0.005)]
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.03) and errors[1] / errors[2] == pytest.approx(2, rel=0.03)


def test_reaction_is_the_change_of_the_derivatives_with_the_policy():
    """A map that is affine in the policy: its reaction is exact, however far the policy is from where it was taken."""
    slope_A, slope_B, slope_w = normal(1, 2, 2, 1, 1, 2), normal(2, 2, 1, 1, 1, 2), normal(3, 2, 1, 1, 2)

    def f(x, u, M):
        changed = [jnp.tensordot(slope, M, 3) for slope in (slope_A, slope_B, slope_w)]
        return (jnp.asarray(A) + changed[0]) @ x + (jnp.asarray(B) + changed[1]) @ u + changed[2] * (1 + x[0] ** 2)

    M0 = jnp.asarray(0.1 * normal(4, 1, 1, 2))
    x = np.zeros(2)
    for _ in range(50):  # Newton's steps to an equilibrium
        gap = np.asarray(f(jnp.asarray(x), jnp.array([0.2]), M0)) - x
        slope = differences(lambda z: f(jnp.asarray(z), jnp.array([0.2]), M0), x)
        x = x + np.linalg.solve(np.eye(2) - slope, gap)
    near = pc.linearise(f, x, [0.2], policy=M0)
    assert np.abs(near.reaction(M0)).max() < 1e-12 and np.abs(near.offset_reaction(M0)).max() < 1e-12
    M = M0 + normal(5, 1, 1, 2)

    def at(policy):
        left = differences(lambda z: f(jnp.asarray(z), jnp.array([0.2]), policy), x)
        right = differences(lambda v: f(x, jnp.asarray(v), policy), [0.2])
        return np.hstack([left, right])

    assert_close(near.reaction(M), at(M) - at(M0), 1e-6)
    assert_close(near.offset_reaction(M), f(x, jnp.array([0.2]), M) - f(x, jnp.array([0.2]), M0), 1e-10)


def test_reaction_serves_as_the_mean_of_a_perturbation():
    def f(x, u, M):
        return (0.5 + 0.1 * M[0, 0, 0]) * x + (1 + 0.2 * M[0, 0, 0]) * u

    near = pc.linearise(f, [0.0], [0.0], policy=np.zeros((1, 1, 1)))
    problem = pc.PerformativeProblem(
        system=near.system,
        horizon=5,
        noise=pc.Gaussian([0.0], [[1.0]]),
        cost=pc.QuadraticCost([[1.0]], [[0.1]]),
        perturbation=pc.DirectionalPerturbation(np.zeros((1, 1, 2)), [0.0], mean=near.reaction),
    )
    M = np.array([[[-0.3]]])
    by_hand = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5 - 0.03]], [[1 - 0.06]]),
        horizon=5,
        noise=pc.Gaussian([0.0], [[1.0]]),
        cost=pc.QuadraticCost([[1.0]], [[0.1]]),
    )
    assert float(pc.expected_cost(problem, M)) == pytest.approx(float(pc.expected_cost(by_hand, M)), rel=1e-12)


def off(x, u):
    return jnp.array([0.5 * x[0] + u[0] - 0.1 * x[0] ** 2])


LINEARISE_REFUSED = {
    "no equilibrium": (lambda: pc.linearise(off, [0.2], [1.0]), "state", "one is at [1.53112887]"),
    "no equilibrium at all": (lambda: pc.linearise(lambda x, u: x + 1, [0.0], [0.0]), "state", "Solve f(Z, θ) = Z"),
    "a number": (lambda: pc.linearise(off, 0.2, [1.0]), "state", "[x]"),
    "another shape": (lambda: pc.linearise(lambda x, u: x[:1], [0.0, 0.0], [0.0]), "f", "(1,)"),
    "not finite": (lambda: pc.linearise(lambda x, u: jnp.log(x), [0.0], [0.0]), "f", "not finite"),
    "a kink of infinite slope": (lambda: pc.linearise(lambda x, u: jnp.sqrt(x), [0.0], [0.0]), "f", "not finite"),
    "an error of its own": (lambda: pc.linearise(lambda x, u: x.missing, [0.0], [0.0]), "f", "missing"),
    "numbers asked for": (
        lambda: pc.linearise(lambda x, u: x if x[0] > 0 else -x, [1.0], [0.0]).error(0.1, key=KEY),
        "f",
        "jax.numpy",
    ),
    "no function": (lambda: pc.linearise(A, [0.0], [0.0]), "f", "callable"),
    "policy of another shape": (lambda: pc.linearise(lambda x, u, M: x, [0.0], [0.0], [[1.0]]), "policy", "(H, 1, 1)"),
    "no key": (lambda: pc.linearise(lambda x, u: x, [0.0], [0.0]).error(1.0, key=None), "key", "jax.random.key(0)"),
    "radius": (lambda: pc.linearise(lambda x, u: x, [0.0], [0.0]).error([1.0], key=KEY), "radius", "one number or 2"),
}


@pytest.mark.parametrize("case", LINEARISE_REFUSED.values(), ids=LINEARISE_REFUSED.keys())
def test_linearise_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
