"""Best responses against independent solves of the quadratic that enumeration gives, CVXPY and closed forms."""

import importlib

import cvxpy as cp
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.world import world_of
from perfcontrol.response import respond, response_jacobian, response_pushforward
from perfcontrol.response.quadratic import quadratic
from tests.evaluate.cases import affine_gradient, case, policies, random_psd, replaced, weights
from tests.tools import assert_close, normal, tolerance

n, m, H, T = 3, 2, 2, 5
DEPLOYED, OTHER = policies(101, H, m, n)
NOISE = pc.Gaussian(np.zeros(n), random_psd(102, n))


def make(noise=NOISE, feasible_set=None, **parts):
    """A problem that reacts, of one fixed shape so that little is compiled twice."""
    law = pc.DirectionalPerturbation(
        0.4 * normal(103, 1, n, n), pc.Affine([0.5], 0.3 * normal(104, 1, H, m, n)), mean=0.1 * normal(105, n, n)
    )
    arguments = {
        "system": pc.LinearSystem(0.4 * normal(106, n, n), normal(107, n, m)),
        "horizon": T,
        "noise": noise,
        "cost": weights(108, n, m, None, targets=False),
        "memory": H,
        "gain": 0.2 * normal(109, m, n),
        "perturbation": law,
        "feasible_set": feasible_set,
        "initial_state": np.ones(n),
    }
    return pc.PerformativeProblem(**(arguments | parts))


traced_respond = eqx.filter_jit(respond)


def answer(problem, deployed):
    """Φ by the engine, worked out from the host."""
    return respond(problem, deployed).M


def dense_minimiser(problem, deployed, row_total=None):
    """Least-norm minimiser of the quadratic, by NumPy least squares on its optimality system."""
    g, hessian = affine_gradient(problem, deployed)
    if row_total is None:
        return np.linalg.lstsq(hessian, -g, rcond=1e-11)[0].reshape(problem.policy_shape)
    lags, rows, columns = problem.policy_shape
    origin = np.full(problem.policy_shape, row_total / columns).reshape(-1)
    tangent = np.eye(g.size) - np.kron(np.eye(lags * rows), np.full((columns, columns), 1 / columns))
    move = np.linalg.lstsq(tangent @ hessian @ tangent, -tangent @ (g + hessian @ origin), rcond=1e-11)[0]
    return (origin + move).reshape(problem.policy_shape)


UNIQUE = {
    "zero-mean noise": lambda: make(),
    "noise with a mean": lambda: make(pc.Gaussian(np.array([0.5, -1.0, 2.0]), random_psd(102, n))),
}
ENUMERABLE = ["scalar with every mean", "everything varies", "everything varies, performative B", "repeated block"]


@pytest.mark.parametrize("name", UNIQUE)
def test_separable_best_response_matches_dense_least_squares(name):
    problem = UNIQUE[name]()
    assert_close(answer(problem, DEPLOYED), dense_minimiser(problem, DEPLOYED), 1e-10)
    assert bool(respond(problem, DEPLOYED).unique)


@pytest.mark.parametrize("varying", [False, True], ids=["constant", "varying"])
@pytest.mark.parametrize("memory", [1, 3, T - 1])
def test_hessian_is_how_the_gradient_grows(memory, varying):
    lead = (T,) if varying else ()
    problem = make(
        pc.Gaussian(np.array([0.5, -1.0, 2.0]), random_psd(102, n)),
        memory=memory,
        system=pc.LinearSystem(0.4 * normal(111, *lead, n, n), normal(112, *lead, n, m)),
        perturbation=pc.DensePerturbation(0.3, mean=0.1 * normal(113, *lead, n, n)),
    )
    policy = jnp.zeros(problem.policy_shape)
    form = eqx.filter_jit(lambda problem, M: quadratic(problem, world_of(problem, M)))(problem, policy)
    assert_close(form.matrix, affine_gradient(problem, policy)[1], 1e-12)


@pytest.mark.parametrize("name", ENUMERABLE)
def test_best_response_zeroes_the_enumerated_gradient(name):
    c = case(name)
    response = answer(c.problem, c.deployed)
    scale = np.abs(c.enumerated(np.zeros(c.problem.policy_shape))[1]).max()
    assert np.abs(c.enumerated(response)[1]).max() < 1e-11 * scale * (1 + np.abs(response).max())


@pytest.mark.float32
def test_best_response_in_the_precision_of_the_run():
    problem = make()
    assert_close(answer(problem, DEPLOYED), dense_minimiser(problem, DEPLOYED), 1e-10, 1e-3)
    assert float(pc.residual(problem, answer(problem, DEPLOYED), deployed=DEPLOYED)) < tolerance(1e-13, 1e-5)


def test_best_response_ignores_noise_covariance_and_initial_state_without_mean_noise():
    base = answer(make(), DEPLOYED)
    other_covariance = pc.Gaussian(np.zeros(n), 5 * random_psd(110, n))
    assert_close(answer(make(other_covariance), DEPLOYED), base, 1e-10)
    assert_close(answer(make(initial_state=np.array([9.0, -50.0, 3.0])), DEPLOYED), base, 1e-12)


@pytest.mark.parametrize("free_input", [False, True], ids=["R > 0", "R = 0"])
def test_best_response_matches_the_closed_form_for_one_lag_and_square_inputs(free_input):
    """Φ = -B⁻¹Ã + (R̄ + BᵀΛ̄B)⁻¹ R̄ B⁻¹A; for R = 0, -B⁻¹Ã whatever D."""
    A, B, K = (
        0.5 * np.asarray(normal(1, 2, 2)),
        np.eye(2) + 0.3 * np.asarray(normal(2, 2, 2)),
        np.asarray(normal(3, 2, 2)),
    )
    Q, R = np.asarray(random_psd(4, 2)), np.asarray(random_psd(5, 2)) * (not free_input)
    K, D, horizon = 0.3 * K, 0.5 * np.asarray(normal(6, 2, 2, 2)), 6
    law = pc.DirectionalPerturbation(D, pc.Affine([0.5, 0.2], normal(7, 2, 1, 2, 2)))
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=horizon,
        noise=pc.Gaussian(np.zeros(2), np.eye(2)),
        cost=pc.QuadraticCost(Q, R),
        gain=K,
        perturbation=law,
    )
    deployed = normal(8, 1, 2, 2)
    closed, scales = A - B @ K, np.asarray(law.scales(deployed, horizon))[0]
    Lambda = [Q + K.T @ R @ K]
    for _ in range(horizon):
        spread = sum(s**2 * d.T @ Lambda[0] @ d for s, d in zip(scales, D, strict=True))
        Lambda.insert(0, Q + K.T @ R @ K + closed.T @ Lambda[0] @ closed + spread)
    R_bar, Lambda_bar, B_inverse = horizon * R, sum(Lambda[2:]), np.linalg.inv(B)
    expected = -B_inverse @ closed + np.linalg.solve(R_bar + B.T @ Lambda_bar @ B, R_bar @ B_inverse @ A)
    assert_close(answer(problem, deployed)[0], expected, 1e-10)


def test_row_sum_best_response_matches_its_closed_form():
    """M̂ = M* + (c - M* b) bᵀΣ⁻¹ / (bᵀΣ⁻¹b) with b = 1."""
    free = np.asarray(answer(make(), DEPLOYED))
    b = np.ones(n)
    weight = np.linalg.solve(np.asarray(NOISE.covariance), b)
    expected = free + (0.7 - free @ b)[..., None] * weight / (b @ weight)
    problem = make(feasible_set=pc.RowSum(0.7))
    response = answer(problem, DEPLOYED)
    assert_close(response, expected, 1e-10)
    assert_close(response, dense_minimiser(problem, DEPLOYED, row_total=0.7), 1e-10)


SETS = {
    "ball": (pc.FrobeniusBall(0.5), lambda M: [cp.norm(cp.vstack(M), "fro") <= 0.5]),
    "simplex": (pc.RowSimplex(0.8), lambda M: [*(cp.sum(lag, axis=1) == 0.8 for lag in M), *(lag >= 0 for lag in M)]),
}


@pytest.mark.parametrize("name", SETS)
def test_constrained_best_response_matches_cvxpy_and_its_variational_inequality(name):
    feasible_set, constraints = SETS[name]
    problem = make(pc.Gaussian(np.array([0.5, -1.0, 2.0]), random_psd(102, n)), feasible_set)
    response = respond(problem, DEPLOYED)
    g, hessian = affine_gradient(problem, DEPLOYED)
    M = [cp.Variable((m, n)) for _ in range(H)]
    flat = cp.hstack([cp.vec(lag, order="C") for lag in M])
    root = np.linalg.cholesky((hessian + hessian.T) / 2)
    program = cp.Problem(cp.Minimize(cp.sum_squares(root.T @ flat) / 2 + g @ flat), constraints(M))
    program.solve(solver=cp.CLARABEL)
    np.testing.assert_allclose(response.M, np.stack([lag.value for lag in M]), atol=2e-5)
    assert bool(response.unique)
    gradient = (g + hessian @ np.asarray(response.M).reshape(-1)).reshape(problem.policy_shape)
    others = jax.vmap(lambda M: feasible_set.project(M))(2 * normal(111, 50, H, m, n))
    gaps = np.einsum("simn,imn->s", np.asarray(others) - np.asarray(response.M), gradient)
    assert gaps.min() > -1e-10 * np.linalg.norm(gradient)
    assert np.linalg.norm(gradient) > 1e-3, "the constraint is not active"
    assert float(pc.residual(problem, response.M, deployed=DEPLOYED)) < 1e-12


def test_best_response_inside_a_ball_is_the_unconstrained_one():
    problem = make(feasible_set=pc.FrobeniusBall(100.0))
    assert_close(answer(problem, DEPLOYED), answer(make(), DEPLOYED), 1e-9)


SINGULAR = pc.Gaussian(np.zeros(n), np.outer([1.0, 2.0, -1.0], [1.0, 2.0, -1.0]))


def test_best_response_is_the_least_norm_one_and_not_unique_when_the_noise_covariance_is_singular():
    problem = make(SINGULAR)
    response = respond(problem, DEPLOYED)
    assert not bool(response.unique)
    assert_close(response.M, dense_minimiser(problem, DEPLOYED), 1e-9)
    unexcited = np.linalg.svd(np.array([[1.0, 2.0, -1.0]]))[2][1:].T
    np.testing.assert_allclose(np.asarray(response.M) @ unexcited, 0, atol=1e-10)


def test_best_response_is_the_least_norm_one_when_a_recorded_disturbance_excites_little():
    c = case("recorded disturbance")
    problem = replaced(c.problem, noise=pc.Sequence(np.outer([1.0, -0.5, 2.0, 0.3], [1.0, 1.0])))
    response = respond(problem, c.deployed)
    assert not bool(response.unique)
    assert_close(response.M, dense_minimiser(problem, c.deployed), 1e-9)


def test_row_sum_best_response_is_the_least_norm_one_when_the_noise_covariance_is_singular():
    problem = make(SINGULAR, pc.RowSum(0.7))
    response = respond(problem, DEPLOYED)
    assert not bool(response.unique)
    assert_close(response.M, dense_minimiser(problem, DEPLOYED, row_total=0.7), 1e-9)


def test_simplex_best_response_is_told_not_unique_when_the_noise_is_a_single_direction():
    problem = make(SINGULAR, pc.RowSimplex(0.8))
    response = respond(problem, DEPLOYED)
    assert not bool(response.unique)
    assert float(pc.residual(problem, response.M, deployed=DEPLOYED)) < 1e-11


DIFFERENTIATED = {
    "regular": lambda: make(),
    "noise with a mean": UNIQUE["noise with a mean"],
    "singular covariance": lambda: make(SINGULAR),
    "row sums": lambda: make(feasible_set=pc.RowSum(0.7)),
    "active ball": lambda: make(feasible_set=SETS["ball"][0]),
    "active simplex": lambda: make(feasible_set=SETS["simplex"][0]),
}


@eqx.filter_jit
def compiled_pushforward(problem, deployed, response, V):
    return response_pushforward(problem, deployed, response)(V)


@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_response_pushforward_matches_central_differences(name):
    problem = DIFFERENTIATED[name]()
    step = 1e-4
    ahead, behind = (np.asarray(respond(problem, DEPLOYED + h * OTHER).M) for h in (step, -step))
    difference = (ahead - behind) / (2 * step)
    assert np.abs(difference).max() > 1e-4, "the response does not move"
    response = respond(problem, DEPLOYED).M
    pushed = compiled_pushforward(problem, DEPLOYED, response, OTHER)
    np.testing.assert_allclose(pushed, difference, atol=2e-7 * (1 + np.abs(difference).max()))
    matrix = response_jacobian(problem, np.asarray(DEPLOYED), response)
    assert isinstance(matrix, np.ndarray)
    np.testing.assert_allclose((matrix @ OTHER.reshape(-1)).reshape(OTHER.shape), pushed, atol=1e-9)


@pytest.mark.parametrize("name", DIFFERENTIATED)
def test_best_response_inside_a_program_is_the_one_from_the_host(name):
    problem = DIFFERENTIATED[name]()
    from_host, traced = respond(problem, DEPLOYED), traced_respond(problem, DEPLOYED)
    assert isinstance(from_host.M, np.ndarray) and isinstance(traced.M, jax.Array)
    assert_close(traced.M, from_host.M, 1e-11)
    assert bool(traced.unique) == bool(from_host.unique)


@pytest.mark.parametrize("name", ["singular covariance", "row sums", "active ball"])
def test_best_response_derivative_is_the_pushforward(name):
    """One method each: separable (and its dense fallback), affine, projected."""
    problem = DIFFERENTIATED[name]()
    response, tangent = jax.jvp(lambda deployed: pc.best_response(problem, deployed), (DEPLOYED,), (OTHER,))
    assert_close(response, answer(problem, DEPLOYED), 1e-11)
    assert_close(tangent, compiled_pushforward(problem, DEPLOYED, response, OTHER), 1e-8)


def test_best_response_moves_with_the_published_sensitivity_when_the_noise_is_constant():
    """Performative prediction: Φ(M') = 2 + 0.6 M', the noise being the constant 1."""
    mean = pc.Affine([[[0.0]], [[1.0]]], np.array([0.0, 0.6]).reshape(2, 1, 1, 1, 1, 1))
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.0]], [[-1.0]]),
        horizon=2,
        noise=pc.Constant(1.0),
        cost=pc.QuadraticCost(np.array([0.0, 0.0, 0.5]).reshape(3, 1, 1), [[0.0]]),
        perturbation=pc.DirectionalPerturbation([[[1.0]]], [[0.0], [0.3]], mean),
    )
    point = jnp.full((1, 1, 1), 4.0)
    value, slope = jax.jvp(lambda M: pc.best_response(problem, M), (point,), (jnp.ones((1, 1, 1)),))
    assert value.item() == pytest.approx(4.4, rel=1e-12)
    assert slope.item() == pytest.approx(0.6, rel=1e-12)


def test_best_response_works_under_vmap_over_deployed_policies():
    problem = make()
    together = jax.jit(jax.vmap(lambda M: respond(problem, M).M))(jnp.stack([DEPLOYED, OTHER]))
    assert_close(together[1], answer(problem, OTHER), 1e-11)


@pytest.mark.parametrize("name", ["row sums", "active ball"])
def test_best_response_without_a_dense_hessian_matches_the_dense_one(name, monkeypatch):
    problem = DIFFERENTIATED[name]()
    dense = answer(problem, DEPLOYED)
    monkeypatch.setattr(importlib.import_module("perfcontrol.response.quadratic"), "DENSE_LIMIT", 1)
    iterative = eqx.filter_jit(lambda problem, M: respond(problem, M).M)(problem, DEPLOYED)
    assert_close(iterative, dense, 1e-9)


def test_residual_is_zero_at_the_best_response_alone():
    problem = make()
    response = answer(problem, DEPLOYED)
    assert float(pc.residual(problem, response, deployed=DEPLOYED)) < 1e-13
    assert float(pc.residual(problem, response + 1e-6, deployed=DEPLOYED)) > 1e-8
    assert float(pc.residual(problem, response, deployed=OTHER)) > 1e-3


def test_residual_follows_its_definition():
    """‖M - Proj(M - ηg)‖ / (‖M‖ + η‖g(0)‖) with η within a tenth below 1/‖Hessian‖."""
    feasible_set = SETS["ball"][0]
    problem = make(feasible_set=feasible_set)
    g, hessian = affine_gradient(problem, DEPLOYED)
    M = feasible_set.project(OTHER)
    gradient = (g + hessian @ np.asarray(M).reshape(-1)).reshape(M.shape)

    def value(step):
        moved = np.linalg.norm(M - feasible_set.project(M - step * gradient))
        return moved / (np.linalg.norm(M) + step * np.linalg.norm(g))

    largest = np.linalg.eigvalsh(hessian).max()
    ends = sorted(value(1 / (factor * largest)) for factor in (0.99, 1.11))
    assert ends[0] <= float(pc.residual(problem, M, deployed=DEPLOYED)) <= ends[1]


def test_best_response_refuses_a_policy_of_the_wrong_shape():
    with pytest.raises(pc.InputError, match=r"`deployed` must have shape .*swapped"):
        pc.best_response(make(), jnp.zeros((H, n, m)))


@pytest.mark.parametrize("name", ["row sums", "active ball", "active simplex"])
def test_response_pushforward_without_a_dense_hessian_matches_finite_differences(name, monkeypatch):
    problem = DIFFERENTIATED[name]()
    direction = OTHER / jnp.linalg.norm(OTHER)
    ahead, behind = (answer(problem, DEPLOYED + sign * 1e-5 * direction) for sign in (1, -1))
    monkeypatch.setattr(importlib.import_module("perfcontrol.response.quadratic"), "DENSE_LIMIT", 1)
    response = answer(problem, DEPLOYED)
    pushed = eqx.filter_jit(
        lambda p, D, R, V: importlib.import_module("perfcontrol.response.respond").response_pushforward(p, D, R)(V)
    )(problem, DEPLOYED, response, direction)
    assert_close(pushed, (ahead - behind) / 2e-5, 1e-6)


def test_best_response_to_noise_with_a_mean_has_no_gradient_at_several_lags():
    """The sums over time behind the factors, lag by lag, against the gradient of one mean path."""
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.8, 0.2], [0.0, 0.6]], [[1.0], [0.5]]),
        horizon=7,
        memory=3,
        noise=pc.Gaussian([1.0, -0.5], np.diag([1.0, 0.3])),
        cost=pc.QuadraticCost(np.eye(2), 0.1 * np.eye(1)),
    )
    M = pc.best_response(problem, jnp.zeros((3, 1, 2)))
    start = jnp.linalg.norm(pc.expected_gradient(problem, jnp.zeros((3, 1, 2))))
    assert float(jnp.linalg.norm(pc.expected_gradient(problem, M))) < 1e-11 * float(start)
