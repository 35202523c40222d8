"""The exact engine against full enumeration, central differences, simulation and published numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.cost_to_go import cost_to_go
from perfcontrol.evaluate.exact import exact_cost
from tests.evaluate.cases import BUILDERS, FiniteNoise, SmoothCost, case, normal, replaced
from tests.oracles.lqr import infinite_horizon_cost, riccati_gain
from tests.tools import assert_close, assert_refused, central_differences, relative_error

EVERY_CASE = pytest.mark.parametrize("name", BUILDERS)


@EVERY_CASE
def test_expected_cost_and_gradient_match_enumeration_of_every_path(name):
    c = case(name)
    cost, gradient = c.enumerated()
    assert float(pc.expected_cost(c.problem, c.M, deployed=c.deployed)) == pytest.approx(cost, rel=1e-11)
    assert relative_error(pc.expected_gradient(c.problem, c.M, deployed=c.deployed), gradient) < 1e-11


@pytest.mark.float32
@pytest.mark.parametrize("name", ["everything varies, performative B", "zero means"])
def test_expected_cost_and_gradient_match_enumeration_in_the_precision_of_the_run(name):
    c = case(name)
    cost, gradient = c.enumerated()
    assert_close(pc.expected_cost(c.problem, c.M, deployed=c.deployed), cost, 1e-11, 1e-5)
    assert_close(pc.expected_gradient(c.problem, c.M, deployed=c.deployed), gradient, 1e-11, 1e-5)


@EVERY_CASE
def test_expected_cost_without_deployed_is_the_performative_cost(name):
    c = case(name)
    assert_close(pc.expected_cost(c.problem, c.M), pc.expected_cost(c.problem, c.M, deployed=c.M), 0, 0)
    assert_close(pc.expected_gradient(c.problem, c.M), pc.expected_gradient(c.problem, c.M, deployed=c.M), 0, 0)


@pytest.mark.parametrize(
    "name", ["scalar with every mean", "everything varies", "repeated block", "reweighted matrices"]
)
def test_total_gradient_matches_central_differences_in_both_policies(name):
    c = case(name)
    total = pc.expected_gradient(c.problem, c.M, total=True)
    differences = central_differences(lambda M: pc.expected_cost(c.problem, M), c.M, step=1e-5)
    assert relative_error(total, differences) < 1e-8
    assert relative_error(pc.expected_gradient(c.problem, c.M), differences) > 1e-3, "the law does not react"


def test_total_gradient_equals_the_partial_one_where_nothing_reacts():
    c = case("nothing reacts")
    assert_close(pc.expected_gradient(c.problem, c.M, total=True), pc.expected_gradient(c.problem, c.M))


def test_total_gradient_is_that_of_automatic_differentiation():
    c = case("everything varies")
    assert_close(
        jax.grad(lambda M: pc.expected_cost(c.problem, M))(c.M), pc.expected_gradient(c.problem, c.M, total=True)
    )


def test_cost_derivative_in_a_squared_scale_matches_its_closed_form():
    """∂C/∂θ_{tk} = tr(D_kᵀ Λ_{t+1} D_k P_t) for 𝒞_t* = Σ_k θ_{tk} D_kᵀ·D_k."""
    c = case("zero means")
    law, T = c.problem.perturbation, c.problem.horizon
    D = np.asarray(law.directions)

    def cost(theta):
        return exact_cost(replaced_scale(c.problem, theta), c.M, c.deployed)

    def replaced_scale(problem, theta):
        return replaced(problem, perturbation=pc.DirectionalPerturbation(law.directions, jnp.sqrt(theta)))

    theta = law.scales(c.deployed, T) ** 2
    derivative = jax.jit(jax.grad(cost))(theta)
    Lambda = np.asarray(cost_to_go(c.problem, c.deployed).Lambda)
    P = np.asarray(pc.state_moments(c.problem, c.M, deployed=c.deployed).second)[:, :2, :2]
    expected = [[np.trace(D[k].T @ Lambda[t] @ D[k] @ P[t]) for k in range(2)] for t in range(T)]
    assert_close(derivative, expected, 1e-11)


def test_gradient_ignores_the_initial_state_and_the_first_two_perturbations_when_means_are_zero():
    c = case("zero means")
    gradient = pc.expected_gradient(c.problem, c.M, deployed=c.deployed)
    moved = replaced(c.problem, initial_state=pc.Constant([50.0, -7.0]))
    assert_close(pc.expected_gradient(moved, c.M, deployed=c.deployed), gradient)
    law = c.problem.perturbation
    scale = pc.Affine(law.scale.offset.at[:2].add(3.0), law.scale.slope)
    louder = replaced(c.problem, perturbation=pc.DirectionalPerturbation(law.directions, scale))
    assert_close(pc.expected_gradient(louder, c.M, deployed=c.deployed), gradient)
    later = pc.Affine(law.scale.offset.at[2].add(3.0), law.scale.slope)
    louder = replaced(c.problem, perturbation=pc.DirectionalPerturbation(law.directions, later))
    assert relative_error(pc.expected_gradient(louder, c.M, deployed=c.deployed), gradient) > 1e-3


def test_diagonal_system_costs_what_the_dense_one_costs():
    c = case("nothing reacts")
    a, b = normal(1, 2), normal(2, 3, 2)
    dense = pc.LinearSystem(jnp.diag(a), jax.vmap(jnp.diag)(b))
    diagonal = replaced(c.problem, system=pc.LinearSystem.diagonal(a, b))
    dense = replaced(c.problem, system=dense)
    for gain in (0, 0.3 * normal(3, 2, 2)):
        one, two = replaced(diagonal, gain=gain), replaced(dense, gain=gain)
        assert_close(pc.expected_cost(one, c.M), pc.expected_cost(two, c.M))
        assert_close(pc.expected_gradient(one, c.M), pc.expected_gradient(two, c.M))


def test_repeated_and_varying_covariances_take_different_routes_to_the_same_cost():
    """A constant law, and the same law handed over as one that varies in time."""
    c = case("nothing reacts")
    atoms = np.array([[1.5, 1.5], [1.5, -0.5], [-0.5, 1.5], [-0.5, -0.5]])
    varying = replaced(c.problem, noise=FiniteNoise(jnp.broadcast_to(jnp.asarray(atoms), (3, 4, 2))))
    assert_close(pc.expected_cost(varying, c.M), pc.expected_cost(c.problem, c.M))
    assert_close(pc.expected_gradient(varying, c.M), pc.expected_gradient(c.problem, c.M))


def test_expected_cost_works_over_a_stack_of_problems():
    c = case("zero means")
    growths = jnp.array([0.5, 1.0, 1.5])

    def cost(growth):
        system = pc.LinearSystem(growth * c.problem.system.A, c.problem.system.B)
        return exact_cost(replaced(c.problem, system=system), c.M, c.deployed)

    together = jax.jit(jax.vmap(cost))(growths)
    assert_close(together[1], pc.expected_cost(c.problem, c.M, deployed=c.deployed))


# --- published numbers ---------------------------------------------------------------------------------------------

A_PUBLISHED = np.array([[0.7, 0.3, 0.2], [-0.2, 0.4, 0.5], [-0.4, 0.2, -0.3]])
B_PUBLISHED = np.array([[0.5, -0.3], [0.8, 0.3], [0.1, 0.9]])
DIRECTION_PUBLISHED = 0.1 * np.array([[2.0, 9.0, -6.0], [9.0, 9.0, 4.0], [-9.0, -2.0, 5.0]])
GAIN_PUBLISHED = -np.array([[-0.2130622, -0.34520195, -0.33427461], [0.39663286, -0.0863928, 0.14257925]])


def long_regulator(gain, scale):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A_PUBLISHED, B_PUBLISHED),
        horizon=400,
        noise=pc.Constant(0.0),
        cost=pc.QuadraticCost(np.eye(3), np.eye(2)),
        gain=gain,
        perturbation=pc.DirectionalPerturbation(DIRECTION_PUBLISHED[None], [scale]),
        initial_state=pc.Gaussian(np.zeros(3), np.eye(3)),
    )


@pytest.mark.parametrize("engine", [pc.expected_cost, pc.expected_cost_by_moments])
def test_multiplicative_noise_lqr_cost_matches_gravell_esfahani_summers(engine):
    cost = engine(long_regulator(GAIN_PUBLISHED, np.sqrt(0.1)), np.zeros((1, 2, 3)))
    assert float(cost) == pytest.approx(4.858605014, abs=1e-8)
    system = pc.LinearSystem(A_PUBLISHED, B_PUBLISHED)
    plain = pc.design_gain(system, Q=np.eye(3), R=np.eye(2))
    cost = engine(long_regulator(plain, 0.0), np.zeros((1, 2, 3)))
    assert float(cost) == pytest.approx(4.062689566, abs=1e-8)


def test_multiplicative_noise_lqr_cost_matches_the_lyapunov_oracle_for_another_gain():
    gain = 0.8 * riccati_gain(A_PUBLISHED, B_PUBLISHED, np.eye(3), np.eye(2))
    expected, _ = infinite_horizon_cost(
        A_PUBLISHED, B_PUBLISHED, gain, DIRECTION_PUBLISHED[None], [0.05], np.eye(3), np.eye(2)
    )
    cost = pc.expected_cost(long_regulator(gain, np.sqrt(0.05)), np.zeros((1, 2, 3)))
    assert float(cost) == pytest.approx(expected, rel=1e-7)


@pytest.mark.slow
def test_best_policy_approaches_the_lqr_optimum_as_the_memory_grows():
    """Without multiplicative noise, from x_0 = 0, around any stabilising gain."""
    A, B, Q, R = np.array([[0.9, 0.5], [0.0, 0.7]]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1)
    horizon = 300
    P, optimum = Q, 0.0
    for _ in range(horizon):
        optimum += np.trace(P)
        gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ gain)
    gaps = []
    for memory in (1, 8):
        problem = pc.PerformativeProblem(
            system=pc.LinearSystem(A, B),
            horizon=horizon,
            noise=pc.Gaussian(np.zeros(2), np.eye(2)),
            cost=pc.QuadraticCost(Q, R),
            memory=memory,
            gain=[[0.1, 0.2]],
        )
        best = pc.best_response(problem, np.zeros(problem.policy_shape))
        gaps.append(float(pc.expected_cost(problem, best)) / optimum - 1)
    assert gaps[0] > 0.01 and 0 < gaps[1] < 0.1 * gaps[0]


MEAN, EPSILON, DEVIATION = 10.0, 0.9, 0.1


def prediction_problem():
    """Performative mean estimation as control: x_2 = z - M with z of mean 10 + 0.9 M' and deviation 0.1."""
    mean = pc.Affine([[[0.0]], [[MEAN - 1]]], np.array([0.0, EPSILON]).reshape(2, 1, 1, 1, 1, 1))
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.0]], [[-1.0]]),
        horizon=2,
        noise=pc.Constant(1.0),
        cost=pc.QuadraticCost(np.array([0.0, 0.0, 0.5]).reshape(3, 1, 1), [[0.0]]),
        perturbation=pc.DirectionalPerturbation([[[1.0]]], [[0.0], [DEVIATION]], mean),
    )


def test_performative_prediction_has_the_cost_and_gradient_of_mean_estimation():
    problem = prediction_problem()
    for decision, deployed in ((3.7, -2.0), (100.0, 100.0), (0.0, 5.0)):
        gap = decision - MEAN - EPSILON * deployed
        arguments = {"M": [[[decision]]], "deployed": [[[deployed]]]}
        assert float(pc.expected_cost(problem, **arguments)) == pytest.approx((gap**2 + DEVIATION**2) / 2, rel=1e-11)
        assert pc.expected_gradient(problem, **arguments).item() == pytest.approx(gap, abs=1e-11)


def test_performative_prediction_stable_point_and_contraction_are_those_published():
    problem = prediction_problem()
    stable = MEAN / (1 - EPSILON)
    assert pc.best_response(problem, [[[stable]]]).item() == pytest.approx(stable, rel=1e-12)
    for deployed in (0.0, 10.0, 500.0):
        response = pc.best_response(problem, [[[deployed]]]).item()
        assert (response - stable) / (deployed - stable) == pytest.approx(EPSILON, rel=1e-10)
    assert float(pc.residual(problem, [[[stable]]])) < 1e-12


# --- bad input -----------------------------------------------------------------------------------------------------


class NoMoments(pc.NoPerturbation):
    def covariance(self, M, horizon):
        return None


@pytest.mark.parametrize(
    "function", [pc.expected_cost, pc.expected_gradient, pc.expected_cost_by_moments, pc.state_moments, pc.residual]
)
def test_exact_evaluation_refuses_what_it_cannot_evaluate(function):
    c = case("nothing reacts")
    assert_refused(lambda: function(replaced(c.problem, cost=SmoothCost()), c.M), "cost", "SmoothCost", "estimate_cost")
    assert_refused(lambda: function(replaced(c.problem, perturbation=NoMoments()), c.M), "perturbation", "NoMoments")
    assert_refused(lambda: function(c.problem, jnp.zeros((2, 3, 2))), "M", "(2, 3, 2)", "(2, 2, 2)")
    assert_refused(lambda: function(c.problem, jnp.full((2, 2, 2), jnp.nan)), "M", "nan at index [0, 0, 0]")
    assert_refused(lambda: function(c.problem, c.M, deployed=np.ones((1, 2, 2))), "deployed", "(1, 2, 2)")


def test_total_gradient_refuses_another_deployed_policy():
    c = case("nothing reacts")
    assert_refused(lambda: pc.expected_gradient(c.problem, c.M, deployed=c.M, total=True), "deployed", "total=True")
