"""Best responses on sets against CVXPY on the quadratic that NumPy enumerates."""

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import perfcontrol as pc
from perfcontrol.response.projected import Projected
from perfcontrol.response.quadratic import Quadratic
from tests.oracles.enumeration import enumerate_cost
from tests.tools import assert_close, normal

T, SHAPE = 3, (2, 2, 2)  # horizon, policy
A, B, K = 0.6 * normal(1, 2, 2), normal(2, 2, 2), 0.1 * normal(3, 2, 2)
DIRECTIONS = 0.3 * normal(4, 1, 2, 4)
MASK = np.array([[[True, False], [True, True]], [[False, True], [False, True]]])
TARGET = [2.0, -1.0]


def problem(feasible_set):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=T,
        memory=2,
        gain=K,
        noise=pc.Rademacher([1.0, 0.5], mean=[0.3, 0.0]),
        cost=pc.QuadraticCost(np.eye(2), 0.3 * np.eye(2), state_target=TARGET),
        perturbation=pc.DirectionalPerturbation(DIRECTIONS, lambda M: 0.5 + M[0, 0, :1] ** 2),
        feasible_set=feasible_set,
        initial_state=[1.0, -1.0],
    )


@pytest.fixture(scope="module")
def enumerated() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A deployed policy, and gradient at zero and Hessian of the cost against it, from gradients at unit policies."""
    deployed = np.asarray(0.4 * normal(5, *SHAPE))
    size = (0.5 + deployed[0, 0, 0] ** 2) * np.asarray(DIRECTIONS[0])
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    laws = {
        "noise": [(np.array([0.3, 0.0]) + signs * np.array([1.0, 0.5]), np.full(4, 0.25))] * T,
        "perturbations": [(np.stack([size, -size]), np.full(2, 0.5))] * T,
        "initial": (np.array([[1.0, -1.0]]), np.ones(1)),
    }

    def gradient(M):
        arrays = {"A": (A, T), "B": (B, T), "K": (K, T + 1), "Q": (np.eye(2), T + 1), "R": (0.3 * np.eye(2), T + 1)}
        tiled = {name: np.broadcast_to(array, (length, 2, 2)) for name, (array, length) in arrays.items()}
        target = np.broadcast_to(TARGET, (T + 1, 2))
        return enumerate_cost(**tiled, M=M.reshape(SHAPE), **laws, state_target=target)[1].reshape(-1)

    linear = gradient(np.zeros(8))
    return deployed, linear, np.stack([gradient(unit) - linear for unit in np.eye(8)], axis=1)


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_best_response_on_an_affine_set_of_one_point_is_that_point(scale):
    """Nothing is left to choose: what rounding leaves of the Hessian must not be inverted."""
    single = pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=6,
        memory=2,
        noise=pc.Rademacher([1.0, 0.5], mean=[0.2, 0.0]),
        cost=pc.QuadraticCost(scale * np.eye(2), 0.5 * scale * np.eye(2)),
        feasible_set=pc.RowSum(0.2),
        structure=pc.RepeatedBlock(2),
    )
    assert_close(pc.best_response(single, np.full((2, 1, 1), 0.2)), np.full((2, 1, 1), 0.2))


CASES = {
    "frobenius ball": (lambda: pc.FrobeniusBall(0.5), lambda M: [cp.norm(cp.hstack(M), "fro") <= 0.5]),
    "spectral ball": (lambda: pc.SpectralBall(0.4), lambda M: [cp.sigma_max(cp.hstack(M)) <= 0.4]),
    "box": (lambda: pc.Box(-0.1, 0.2), lambda M: [c for lag in M for c in (lag >= -0.1, lag <= 0.2)]),
    "support": (lambda: pc.Support(MASK), lambda M: [cp.multiply(~MASK[i], lag) == 0 for i, lag in enumerate(M)]),
    "rows in a box": (
        lambda: pc.Intersection([pc.RowSum(0.1), pc.Box(-0.1, 0.25)]),
        lambda M: [c for lag in M for c in (lag >= -0.1, lag <= 0.25, cp.sum(lag, axis=1) == 0.1)],
    ),
    "support and rows": (
        lambda: pc.Intersection([pc.Support(MASK), pc.RowSum(0.2)]),
        lambda M: [c for i, lag in enumerate(M) for c in (cp.multiply(~MASK[i], lag) == 0, cp.sum(lag, axis=1) == 0.2)],
    ),
    "spectral ball and simplex": (
        lambda: pc.Intersection([pc.SpectralBall(0.6), pc.RowSimplex(0.4)]),
        lambda M: [
            cp.sigma_max(cp.hstack(M)) <= 0.6,
            *[c for lag in M for c in (lag >= 0, cp.sum(lag, axis=1) == 0.4)],
        ],
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_best_response_matches_cvxpy_on_the_enumerated_quadratic(name, enumerated):
    feasible_set, constraints = CASES[name]
    deployed, linear, hessian = enumerated
    response = pc.best_response(problem(feasible_set()), deployed)

    M = [cp.Variable((2, 2)) for _ in range(2)]
    vector = cp.hstack([cp.vec(lag, order="C") for lag in M])
    objective = cp.quad_form(vector, cp.psd_wrap((hessian + hessian.T) / 2)) / 2 + linear @ vector
    judge = cp.Problem(cp.Minimize(objective), constraints(M))
    judge.solve(solver=cp.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)

    flat = np.asarray(response).reshape(-1)
    value = flat @ hessian @ flat / 2 + linear @ flat
    assert value == pytest.approx(judge.value, rel=1e-8, abs=1e-8)
    assert_close(response, np.stack([lag.value for lag in M]), 1e-5)
    free = np.linalg.solve(hessian, -linear).reshape(SHAPE)
    assert np.linalg.norm(free - np.asarray(response)) > 1e-3, "the constraint does not bind"


@jax.jit
def _minimise(quadratic_form, linear, ball):
    """The engine's minimiser of <N, form N>/2 + <linear, N> on a ball, six free parameters."""
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(np.eye(3), np.ones((3, 2))),
        horizon=2,
        noise=pc.Rademacher(np.ones(3)),
        cost=pc.QuadraticCost(np.eye(3), np.eye(2)),
        feasible_set=ball,
    )
    linear = linear.reshape(problem.policy_shape)
    step = 1 / jnp.linalg.norm(quadratic_form, 2)

    form = Quadratic(linear, step, quadratic_form)
    M, unique = Projected(problem.feasible_set, form).minimise(jnp.zeros_like(linear))
    return M.reshape(-1), unique


def test_projected_response_matches_the_secular_equation_when_the_ball_is_barely_active():
    """Ill-conditioned quadratics whose minimiser lies just outside the ball: Newton starts on the wrong face."""
    for seed in range(200):
        r = np.random.default_rng(seed)
        vectors, _ = np.linalg.qr(r.standard_normal((6, 6)))
        values = np.geomspace(1, 10 ** r.uniform(1, 4), 6)
        free = r.standard_normal(6)
        radius = np.linalg.norm(free) * (1 - 10 ** r.uniform(-6, -1))
        linear = -vectors @ (values * (vectors.T @ free))

        def excess(multiplier, values=values, vectors=vectors, linear=linear, radius=radius):
            return np.linalg.norm((vectors.T @ linear) / (values + multiplier)) - radius

        multiplier = scipy.optimize.brentq(excess, 0, 1e6, xtol=1e-15, rtol=1e-15)
        expected = -vectors @ ((vectors.T @ linear) / (values + multiplier))
        found, unique = _minimise(vectors @ np.diag(values) @ vectors.T, linear, pc.FrobeniusBall(radius))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * radius, err_msg=str(seed))
        assert bool(unique)
