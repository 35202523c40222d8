"""Numbers that are hard on arithmetic: a right answer, or a refusal with a name; never a wrong or an empty number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.tools import assert_close, assert_refused, normal

KEY = jax.random.key(1)


def plant(n=2, m=2, T=6, H=2, growth=0.6, noise=1.0, cost=1.0, sensitivity=0.3, covariance=None, **rest):
    """A reaction that grows with the policy; `noise` and `cost` are scales of the answer's own units."""
    covariance = np.eye(n) if covariance is None else covariance
    return pc.PerformativeProblem(
        system=pc.LinearSystem(growth * (np.eye(n) + 0.1 * np.eye(n, k=1)), np.asarray(normal(4, n, m))),
        horizon=T,
        noise=pc.Gaussian(np.zeros(n), noise**2 * covariance),
        cost=pc.QuadraticCost(cost * np.eye(n), cost * np.eye(m)),
        memory=H,
        perturbation=pc.DirectionalPerturbation(0.3 * np.eye(n)[None], pc.Norm([0.1], [sensitivity])),
        **rest,
    )


@pytest.mark.parametrize("scales", [(1.0, 1e100), (1.0, 1e-100), (1e50, 1.0), (1e-50, 1.0), (1e50, 1e-100)])
def test_units_of_noise_and_cost_do_not_change_the_stable_policy(scales):
    noise, cost = scales
    usual, scaled = pc.solve(plant(), pc.StablePoint()), pc.solve(plant(noise=noise, cost=cost), pc.StablePoint())
    assert_close(scaled.M, usual.M, 1e-9)
    factor = noise**2 * cost
    expected = factor * float(pc.expected_cost(plant(), usual.M))
    assert_close(pc.expected_cost(plant(noise=noise, cost=cost), scaled.M), expected, 1e-9)


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


def test_ill_conditioned_loop_is_certified_or_refused_with_a_reason():
    A = np.array([[0.5, 1e6], [0.0, 0.4]])
    found = pc.strong_stability(pc.LinearSystem(A, np.eye(2)), np.zeros((2, 2)))
    Q, L = np.asarray(found.Q), np.asarray(found.L)
    assert found.verified and found.kappa >= 500
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
