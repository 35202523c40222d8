"""PerformativeOptimum against closed forms, enumeration with an outer solver, and the policies it must not exceed."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import perfcontrol as pc
from tests.contracts.solver import SolverContract
from tests.oracles import performative_optima
from tests.oracles.enumeration import enumerate_cost
from tests.solvers.problems import drifting, strongly_performative
from tests.theory.problems import random_problem
from tests.tools import assert_close, assert_refused, central_differences, normal

SOLVER = pc.PerformativeOptimum(starts=4, max_steps=20)  # one for all tests: equal shapes share what is compiled


class TestPerformativeOptimum(SolverContract):
    close = (1e-9, 2e-3)
    test_history_keeps_the_record_of_every_other_step = None  # the loop's work: tested with cheaper solvers

    def solver(self):
        return SOLVER

    @pytest.mark.float32
    def test_optimum_is_no_dearer_than_stable_and_naive_policies(self):
        for problem, solution in zip(self.problems, self.singles, strict=True):
            for other in (pc.solve(problem, pc.StablePoint()).M, pc.best_response(problem, problem.initial_policy())):
                assert float(solution.stats["cost"]) < float(pc.expected_cost(problem, other))

    @pytest.mark.float32
    def test_optimum_reports_its_cost_and_a_total_residual_within_the_tolerance(self):
        for problem, solution in zip(self.problems, self.singles, strict=True):
            assert_close(solution.stats["cost"], pc.expected_cost(problem, solution.M), 1e-13, 1e-5)
            residual = float(pc.residual(problem, solution.M, total=True))
            assert residual <= (1e-11 if problem.dtype == jnp.float64 else 1e-5)
            assert bool(solution.stats["unique"])
            assert float(pc.residual(problem, solution.M)) > 1e-4, "an optimum need not be stable"

    def test_first_step_counts_as_one(self):
        assert int(pc.solve(self.problems[0], SOLVER, max_steps=1, throw=False).steps) == 1


# --- closed forms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("build", "settings"),
    [
        (performative_optima.location, (10.0, 0.4, 0.5)),
        (performative_optima.location, (10.0, 3.0, 0.5)),  # repeated minimisation diverges
        (performative_optima.scale, (10.0, 0.7)),
        (performative_optima.pricing, (3.0, 0.8)),
        (performative_optima.linear, (np.array([1.0, -2.0]), np.array([[0.3, 0.9], [-0.5, 0.2]]), 0.3)),
    ],
    ids=["location", "far location", "scale", "pricing", "linear"],
)
def test_optimum_is_the_published_one_and_not_the_stable_one(build, settings):
    problem, stable, optimal = build(*settings)

    def policy(decision):
        M = np.zeros(problem.policy_shape)
        M[0, :, 0] = decision
        return jnp.asarray(M)

    assert float(jnp.max(jnp.abs(problem.feasible_set.project(pc.expected_gradient(problem, policy(stable)))))) < 1e-10
    solution = pc.solve(problem, SOLVER)
    assert_close(solution.M, policy(optimal), 1e-9)
    assert float(solution.stats["cost"]) < float(pc.expected_cost(problem, policy(stable)))


# --- enumeration with an outer solver --------------------------------------------------------------------------------


def _system(seed):
    A, B, K = 0.5 * normal(seed, 2, 2), normal(seed + 1, 2, 1), 0.2 * normal(seed + 2, 1, 2)
    return np.asarray(A), np.asarray(B), np.asarray(K)


@pytest.mark.parametrize("seed", [0, 3])
def test_optimum_is_where_an_outer_solver_ends_on_the_enumerated_performative_cost(seed):
    T, n, m = 3, 2, 1
    A, B, K = _system(seed)
    D, slope = np.asarray(normal(seed + 3, n, n)), np.asarray(normal(seed + 4, 1, m, n))

    def variance(M):
        return 0.05 + 0.5 * np.tanh(np.sum(slope * M)) ** 2

    def enumerated(flat):
        M = flat.reshape(1, m, n)
        root = np.sqrt(variance(M))
        noise = [(np.array([[1.0, 0.5], [1.0, -0.5], [-1.0, 0.5], [-1.0, -0.5]]) + 0.2, np.full(4, 0.25))] * T
        return enumerate_cost(
            **{"A": np.broadcast_to(A, (T, n, n)), "B": np.broadcast_to(B, (T, n, m))},
            **{"K": np.broadcast_to(K, (T + 1, m, n)), "Q": np.broadcast_to(np.eye(n), (T + 1, n, n))},
            **{"R": np.broadcast_to(np.eye(m), (T + 1, m, m)), "M": M, "noise": noise},
            perturbations=[(np.stack([root * D, -root * D]), np.array([0.5, 0.5]))] * T,
            initial=(np.array([[1.0, -1.0]]), np.array([1.0])),
        )[0]

    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=T,
        noise=pc.Rademacher([1.0, 0.5], mean=[0.2, 0.2]),
        cost=pc.QuadraticCost(np.eye(n), np.eye(m)),
        gain=K,
        perturbation=pc.DirectionalPerturbation(
            D[None], pc.Function(lambda M, s: jnp.sqrt(0.05 + 0.5 * jnp.tanh(jnp.sum(s * M)) ** 2)[None], slope)
        ),
        initial_state=[1.0, -1.0],
    )
    solution = pc.solve(problem, SOLVER)
    starts = [np.zeros(n), *np.random.default_rng(seed).normal(size=(3, n))]
    found = min((scipy.optimize.minimize(enumerated, start, tol=1e-12) for start in starts), key=lambda end: end.fun)
    assert_close(solution.stats["cost"], found.fun, 1e-9)
    assert_close(solution.M.reshape(-1), found.x, 1e-4)


# --- never dearer, and the gradient it works with --------------------------------------------------------------------


@pytest.mark.parametrize("bounded", [True, False])
def test_optimum_never_costs_more_than_the_stable_policy_on_random_problems(bounded):
    cheaper = 0
    for seed in range(12):
        problem = random_problem(seed, bounded=bounded, strength=1.0)
        stable = pc.solve(problem, pc.StablePoint(), throw=False).M
        optimal = pc.solve(problem, SOLVER, throw=False)
        dear = float(pc.expected_cost(problem, stable))
        assert optimal.result == pc.Result.success, seed
        assert float(optimal.stats["cost"]) <= dear * (1 + 1e-12), seed
        cheaper += float(optimal.stats["cost"]) < dear * (1 - 1e-6)
    assert cheaper >= 9


def test_optimum_is_a_fraction_of_the_stable_cost_where_the_reaction_is_strong():
    problem = strongly_performative()
    solution = pc.solve(problem, pc.PerformativeOptimum(starts=1))
    assert 4 * float(solution.stats["cost"]) < float(pc.expected_cost(problem, pc.solve(problem, pc.StablePoint()).M))


def test_total_gradient_matches_central_differences_to_seven_digits():
    for problem in (
        random_problem(5, bounded=False, strength=0.3),
        drifting(0),
        performative_optima.pricing(3, 0.8)[0],
    ):
        M = 0.3 * normal(9, *problem.policy_shape)
        expected = central_differences(lambda P, p=problem: pc.expected_cost(p, P), M, 1e-5)
        assert_close(pc.expected_gradient(problem, M, total=True), expected, 1e-7)


def test_residual_of_the_total_gradient_tells_optimal_from_stable():
    problem = drifting(0, pc.FrobeniusBall(0.3))
    stable, optimal = (pc.solve(problem, solver).M for solver in (pc.StablePoint(), SOLVER))
    assert float(pc.residual(problem, optimal, total=True)) < 1e-11 < 1e-4 < float(pc.residual(problem, optimal))
    assert float(pc.residual(problem, stable)) < 1e-11 < 1e-4 < float(pc.residual(problem, stable, total=True))
    assert_refused(lambda: pc.residual(problem, stable, deployed=optimal, total=True), "deployed", "left out")


def test_optimum_is_called_not_unique_where_a_column_meets_no_noise():
    problem, _, optimal = performative_optima.linear(np.array([1.0, -2.0]), np.array([[0.3, 0.9], [-0.5, 0.2]]), 0.3)
    free = pc.PerformativeProblem(
        system=problem.system,
        horizon=2,
        noise=problem.noise,
        cost=problem.cost,
        perturbation=problem.perturbation,
    )
    solution = pc.solve(free, SOLVER)
    assert_close(solution.M[0, :, 0], optimal, 1e-9)
    assert not bool(solution.stats["unique"])


# --- refusals --------------------------------------------------------------------------------------------------------


def test_optimum_is_refused_with_a_four_part_error():
    assert_refused(lambda: pc.PerformativeOptimum(starts=0), "starts", "at least 1")
    assert_refused(lambda: pc.PerformativeOptimum(starts=2.5), "starts", "integer")
    assert_refused(lambda: pc.solve(drifting(), pc.PerformativeOptimum(tolerance=1e-30)), "tolerance")
    assert_refused(lambda: pc.solve(drifting(), pc.PerformativeOptimum(tolerance=-1.0)), "tolerance", "positive")


def test_optimum_names_a_world_that_overflows_and_returns_a_finite_policy():
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[1e200]], [[1.0]]),
        horizon=4,
        noise=pc.Rademacher([1.0]),
        cost=pc.QuadraticCost([[1.0]], [[1.0]]),
    )
    solution = pc.solve(problem, SOLVER, throw=False)
    assert solution.result == pc.Result.nonfinite
    assert bool(jnp.all(jnp.isfinite(solution.M)))
