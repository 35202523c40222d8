"""Numbers that are hard on arithmetic: a right answer, or a refusal with a name; never a wrong or an empty number."""

import importlib
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.oracles.moments import expected_cost_moments
from tests.tools import DOUBLE, assert_close, assert_refused, normal, tolerance

KEY = jax.random.key(1)


def plant(n=2, m=2, T=6, H=2, growth=0.6, coupling=0.1, noise=1.0, cost=1.0, sensitivity=0.3, covariance=None, **rest):
    """A reaction that grows with the policy; `noise` and `cost` are scales of the answer's own units."""
    covariance = np.eye(n) if covariance is None else covariance
    return pc.PerformativeProblem(
        system=pc.LinearSystem(growth * (np.eye(n) + coupling * np.eye(n, k=1)), np.asarray(normal(4, n, m))),
        horizon=T,
        noise=pc.Gaussian(np.zeros(n), noise**2 * covariance),
        cost=pc.QuadraticCost(cost * np.eye(n), cost * np.eye(m)),
        memory=H,
        perturbation=pc.DirectionalPerturbation(0.3 * np.eye(n)[None], pc.Norm([0.1], [sensitivity])),
        **rest,
    )


fractions = np.vectorize(
    lambda number: Fraction(number if isinstance(number, Fraction) else float(number)), otypes=[object]
)


def without_rounding(problem, M, deployed):
    """C_T(M; deployed) of a `plant` in fractions: the right answer to the numbers that it holds."""
    n, m, T = problem.state_size, problem.input_size, problem.horizon
    every = lambda array, times=T: np.broadcast_to(fractions(array), (times, *array.shape))  # noqa: E731
    offset, weight = (float(part[0]) for part in (problem.perturbation.scale.offset, problem.perturbation.scale.weight))
    direction = fractions(problem.perturbation.directions[0])
    variance = fractions(offset + weight * np.linalg.norm(np.asarray(deployed, float))).item() ** 2
    zero = fractions(np.zeros(n))
    return expected_cost_moments(
        every(problem.system.A), every(problem.system.B), every(np.zeros((m, n)), T + 1),
        every(problem.cost.Q, T + 1), every(problem.cost.R, T + 1), fractions(M), every(np.zeros(n)),
        every(problem.noise.covariance), every(np.zeros((n, n))),
        lambda t, X: variance * direction @ X @ direction.T, zero, np.outer(zero, zero), number=object,
    )  # fmt: skip


def slope(problem, M, deployed, along):
    """The derivative of the same by M: differences are exact for a quadratic."""
    M, along = fractions(M), fractions(along)
    return (without_rounding(problem, M + along, deployed) - without_rounding(problem, M - along, deployed)) / 2


HARD = {
    "growth 30": {"growth": 30.0, "H": 1},
    "nearly singular noise": {"covariance": np.diag([1.0, 1e-12])},
    "no reaction": {"sensitivity": 0.0},
    "a transient of 1e6": {"growth": 0.5, "coupling": 2e6, "sensitivity": 0.0, "H": 1},
    "longest memory": {"H": 5},
    "one state": {"n": 1, "m": 1, "T": 4},
    "one step": {"n": 1, "m": 1, "T": 2, "H": 1},
    "more inputs than states": {"n": 2, "m": 4, "H": 1},
    "couplings below normal numbers": {"coupling": 1e-309},
}
DOUBLE_ONLY = {
    "growth 1e18": {"growth": 1e18},
    "a transient of 1e12": {"growth": 0.5, "coupling": 2e12, "sensitivity": 0.0},
    "large noise": {"noise": 1e100},
    "small noise": {"noise": 1e-100},
    "large cost": {"cost": 1e100},
    "small cost": {"cost": 1e-100},
}


@pytest.mark.float32
@pytest.mark.parametrize("case", [*HARD, *(DOUBLE_ONLY if DOUBLE else {})])
def test_costs_gradients_and_stable_policies_match_arithmetic_without_rounding(case):
    problem = plant(**(HARD | DOUBLE_ONLY)[case])
    M, deployed, along = (np.asarray(normal(seed, *problem.policy_shape)) for seed in (1, 2, 3))
    exact = without_rounding(problem, M, deployed)
    assert_close(pc.expected_cost(problem, M, deployed=deployed), exact, 1e-13, 1e-5)
    gradient = pc.expected_gradient(problem, M, deployed=deployed)
    assert_close(np.sum(gradient * along), slope(problem, M, deployed, along), 1e-12, 1e-4)
    S = pc.solve(problem, pc.StablePoint(), throw=False).M
    assert abs(slope(problem, S, S, along)) <= tolerance(1e-10, 1e-4) * abs(slope(problem, 0 * S, S, along))


@pytest.mark.float32
@pytest.mark.parametrize("growth", [4.0, 1e2, 1e4, *([1e8, 1e20] if DOUBLE else [])])
def test_a_cost_that_feedforward_cancels_has_two_right_digits_or_is_refused(growth):
    problem = plant(growth=growth, sensitivity=0.0)
    costs, refused = (pc.expected_cost, pc.expected_cost_by_moments), 0
    try:
        M = pc.best_response(problem, problem.initial_policy())
    except OverflowError:
        return
    exact = float(without_rounding(problem, M, M))
    for cost in costs:
        try:
            assert abs(float(cost(problem, M)) - exact) <= 1e-2 * exact
        except OverflowError as error:
            assert "lost in the rounding" in str(error) and "pc.design_gain" in str(error)
            refused += 1
    remains = exact / float(without_rounding(problem, 0 * M, M))
    assert refused == (len(costs) if remains < 1000 * np.finfo(problem.dtype).eps else 0)


@pytest.mark.parametrize("feasible_set", [pc.Unconstrained(), pc.FrobeniusBall(0.1), pc.RowSum(0.1)])
def test_units_of_noise_and_cost_do_not_change_the_stable_policy(feasible_set):
    usual = pc.solve(plant(feasible_set=feasible_set), pc.StablePoint())
    cost = float(pc.expected_cost(plant(), usual.M))
    for units in ((1.0, 1e100), (1.0, 1e-100), (1e100, 1.0), (1e-100, 1.0), (1e50, 1e-100), (1e80, 1e80)):
        problem = plant(noise=units[0], cost=units[1], feasible_set=feasible_set)
        scaled = pc.solve(problem, pc.StablePoint())
        assert_close(scaled.M, usual.M, 1e-9)
        assert_close(pc.expected_cost(problem, scaled.M), units[0] ** 2 * units[1] * cost, 1e-9)


def test_units_do_not_change_a_best_response_by_products_alone(monkeypatch):
    def response(**units):
        problem = plant(feasible_set=pc.RowSum(0.1), **units)
        return pc.best_response(problem, problem.initial_policy())

    usual = response()
    monkeypatch.setattr(importlib.import_module("perfcontrol.response.quadratic"), "DENSE_LIMIT", 1)
    for units in ({"cost": 1e100}, {"cost": 1e-100}, {"noise": 1e100}, {"noise": 1e-100}):
        assert_close(response(**units), usual, 1e-9)


def test_weights_and_covariances_below_normal_numbers_are_refused():
    # Compiled programs flush them to zero: the world without costs, where any policy would be stable.
    assert_refused(lambda: plant(cost=1e-310), "Q", "zero", "units")
    assert_refused(lambda: plant(noise=1e-155), "covariance", "zero", "units")
    assert pc.solve(plant(cost=1e-300), pc.StablePoint()).result == pc.Result.success
    plant(cost=0.0)


def test_overflowing_growth_is_refused_by_name():
    problem = plant(growth=1e150)
    with pytest.raises(OverflowError, match="overflows float64"):
        pc.expected_cost(problem, problem.initial_policy())
    for solver, key in ((pc.StablePoint(), None), (pc.RRM(), None), (pc.RSGD(5, 0.1), KEY)):
        solution = pc.solve(problem, solver, key=key, throw=False)
        assert solution.result != pc.Result.success and np.all(np.isfinite(solution.M))


@pytest.mark.parametrize("small", [1e-6, 1e-12])
def test_nearly_singular_noise_leaves_the_response_of_zero_mean_noise_as_it_is(small):
    # With every Σ_s = Σ the best response does not depend on Σ, only on how well it is determined.
    usual = pc.best_response(plant(), plant().initial_policy())
    hard = plant(covariance=np.diag([1.0, small]))
    assert_close(pc.best_response(hard, hard.initial_policy()), usual, 1e-8)


@pytest.mark.parametrize("shape", [(1, 1, 6, 5), (1, 1, 2, 1), (1, 3, 5, 2), (2, 4, 6, 5), (3, 1, 4, 3)])
def test_small_sizes_more_inputs_than_states_and_the_longest_memory_agree_with_simulation(shape):
    n, m, T, H = shape
    problem = plant(n, m, T, H, sensitivity=0.05)
    solution = pc.solve(problem, pc.StablePoint())
    assert float(pc.residual(problem, solution.M)) <= 1e-11
    estimate = pc.estimate_cost(problem, solution.M, key=KEY, samples=4000)
    exact = float(pc.expected_cost(problem, solution.M))
    assert abs(float(estimate.mean) - exact) <= 5 * float(estimate.standard_error)


def test_without_reaction_one_minimisation_is_stable_and_optimal():
    problem = plant(sensitivity=0.0)
    stable = pc.solve(problem, pc.StablePoint())
    assert_close(stable.M, pc.best_response(problem, problem.initial_policy()), 1e-11)
    assert_close(pc.expected_gradient(problem, stable.M, total=True), np.zeros(stable.M.shape), 1e-9)


@pytest.mark.filterwarnings("ignore:An ill-conditioned matrix")
@pytest.mark.parametrize("transient", [1e6, 1e12])
def test_ill_conditioned_loop_is_certified_with_the_kappa_that_it_needs(transient):
    A = np.array([[0.5, transient], [0.0, 0.4]])
    found = pc.strong_stability(pc.LinearSystem(A, np.eye(2)), np.zeros((2, 2)))
    Q, L = np.asarray(found.Q), np.asarray(found.L)
    assert found.verified and np.sqrt(transient) / 2 <= found.kappa <= 100 * np.sqrt(transient)
    assert_close(Q @ L @ np.linalg.inv(Q), A, 1e-8)


def _kinked(M, params):
    return (0.1 + params * jnp.linalg.norm(M))[None]


def kinked():
    scale = pc.Function(_kinked, jnp.asarray(0.5))
    ball = pc.FrobeniusBall(1.0)
    problem = plant(n=2, m=1, H=1, feasible_set=ball)
    perturbation = pc.DirectionalPerturbation(0.3 * np.eye(2)[None], scale)
    return pc.PerformativeProblem(
        system=problem.system, horizon=6, noise=problem.noise, cost=problem.cost, feasible_set=ball,
        perturbation=perturbation,
    )  # fmt: skip


def test_reaction_without_derivative_is_named_with_its_remedy():
    solution = pc.solve(kinked(), pc.Continuation(), throw=False)
    assert solution.result == pc.Result.not_differentiable
    with pytest.raises(pc.SolveError, match=r"pc\.Norm"):
        pc.solve(kinked(), pc.Continuation())
    gradient = lambda: pc.expected_gradient(kinked(), kinked().initial_policy(), total=True)  # noqa: E731
    assert_refused(gradient, "perturbation", "pc.Norm")
    assert pc.solve(kinked(), pc.StablePoint()).result == pc.Result.success
