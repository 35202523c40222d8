"""StablePoint: beyond repeated minimisation, without a fixed point, and where the minimiser is not unique."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import perfcontrol as pc
from perfcontrol.solvers.opening import secant_direction
from tests.contracts.solver import SolverContract
from tests.oracles.performative_prediction import stable_decision
from tests.solvers.problems import MEAN, drifting, performative_prediction, strongly_performative
from tests.tools import assert_close, central_differences, normal

SOLVER = pc.StablePoint(max_steps=30)  # one for all tests, so that problems of equal shape share what is compiled


class TestStablePoint(SolverContract):
    test_history_keeps_the_record_of_every_other_step = None  # the loop's work: tested with cheaper solvers

    def solver(self):
        return SOLVER

    @pytest.mark.float32
    def test_stable_point_is_where_repeated_minimisation_goes(self):
        for problem, solution in zip(self.problems, self.singles, strict=True):
            assert_close(solution.M, pc.solve(problem, pc.RRM(max_steps=40)).M, 1e-9, 1e-3)

    @pytest.mark.float32
    def test_stable_point_has_a_natural_residual_within_the_tolerance(self):
        for problem, solution in zip(self.problems, self.singles, strict=True):
            residual = float(pc.residual(problem, solution.M))
            assert residual <= (1e-11 if problem.dtype == jnp.float64 else 1e-5)
            assert abs(float(solution.stats["residual"]) - residual) <= 1e-3 * residual + 1e-6
            assert bool(solution.stats["unique"])


# --- the first steps ----------------------------------------------------------------------------------------------


def weakly_reacting(slope: float, plain: bool = True) -> pc.PerformativeProblem:
    n = 3 if plain else 4
    A, B, directions = 0.4 * normal(1, n, n), normal(2, n, 2), 0.2 * normal(3, 2, n, n)
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=12,
        memory=2,
        noise=pc.Rademacher(np.ones(n), mean=0 if plain else 0.3 * np.ones(n)),
        cost=pc.QuadraticCost(np.eye(n), np.eye(2)),
        perturbation=pc.DirectionalPerturbation(directions, lambda M: slope * (1 + jnp.sum(M**2)) * jnp.ones(2)),
        feasible_set=pc.Unconstrained() if plain else pc.RowSum(0.4),
        structure=pc.FullStructure() if plain else pc.RepeatedBlock(2),
    )


@pytest.mark.parametrize(("slope", "plain"), [(0.3, True), (1.0, True), (0.3, False)])
@pytest.mark.parametrize("max_steps", [None, 3])
def test_first_steps_in_one_program_are_those_that_follow_one_another(slope, plain, max_steps, monkeypatch):
    problem = weakly_reacting(slope, plain)

    def run():
        return pc.solve(problem, SOLVER, max_steps=max_steps, record=jnp.sum, every=2, throw=False)

    together = run()
    monkeypatch.setattr(pc.StablePoint, "opening", lambda *_: None)
    apart = run()
    assert int(together.steps) == int(apart.steps) and together.result == apart.result
    assert_close(together.history, apart.history, 1e-11)
    assert_close(together.M, apart.M, 1e-11)
    assert abs(float(together.stats["residual"]) - float(apart.stats["residual"])) <= 1e-13


# --- beyond repeated minimisation ------------------------------------------------------------------------------------


@pytest.mark.float32
@pytest.mark.parametrize("sensitivity", [0.9, 1.5, -3.0, 40.0, 0.0])
def test_stable_point_matches_the_published_one_whatever_the_sensitivity(sensitivity):
    problem = performative_prediction(sensitivity)
    stable = np.full((1, 1, 1), stable_decision(MEAN, sensitivity))
    for start in (None, [[[-350.0]]], [[[1e4]]]):
        solution = pc.solve(problem, SOLVER, start)
        assert_close(solution.M, stable, 1e-12 if start is None else 1e-9, 1e-3)
        assert bool(solution.stats["unique"])


def test_best_response_derivative_is_the_published_sensitivity_when_the_covariance_is_singular():
    problem = performative_prediction(1.5)
    slope = jax.jacfwd(lambda M: pc.best_response(problem, M))(jnp.full((1, 1, 1), 3.0))
    assert_close(slope.reshape(()), 1.5, 1e-12)


@pytest.mark.parametrize(("mean", "start"), [(10.0, None), (-7.3, None), (0.1, [[[33.0]]]), (3.7, [[[-1e4]]])])
def test_stable_point_is_not_claimed_when_none_exists(mean, start):
    for sensitivity in (1.0, 1.0 + 2.3e-16, 1.0 - 1.2e-16):  # at the last two there is one, at 1e16
        problem = performative_prediction(sensitivity, mean=mean)
        solution = pc.solve(problem, SOLVER, start, throw=False)
        assert solution.result == pc.Result.not_converged
        assert bool(jnp.all(jnp.isfinite(solution.M))) and float(jnp.max(jnp.abs(solution.M))) < 1e13
        with pytest.raises(pc.SolveError, match="no fixed point"):
            pc.solve(problem, SOLVER, start)


def test_stable_point_takes_two_steps_and_the_answer_when_the_response_is_affine():
    """Evaluate the start, minimise once, see that it does not contract, and let one Newton step be the last."""
    problem = performative_prediction(1.5)
    assert int(pc.solve(problem, SOLVER).steps) == 3


def test_stable_point_never_minimises_again_after_newton_when_minimisation_expands():
    problem = strongly_performative()
    errors = jnp.sqrt(jnp.sum((pc.solve(problem, SOLVER).history - pc.solve(problem, SOLVER).M) ** 2, axis=(1, 2, 3)))
    gaps = np.asarray(errors[np.argmax(np.asarray(errors) < 0.1) :])
    assert np.all(np.diff(gaps) <= 0), "the error grows again near the stable policy"


@pytest.mark.parametrize("slope", [8.0, 20.0])
def test_stable_point_solves_the_fixed_point_equation_when_repeated_minimisation_cycles(slope):
    problem = strongly_performative(slope)
    solution = pc.solve(problem, SOLVER)
    M = solution.M
    assert float(pc.residual(problem, M)) <= 1e-11
    assert_close(pc.best_response(problem, M), M, 1e-10)

    direction = normal(7, *M.shape)
    for _ in range(2):  # a power iteration: the derivative of Φ has one large eigenvalue
        direction = direction / jnp.linalg.norm(direction)
        pushed = (
            pc.best_response(problem, M + 1e-5 * direction) - pc.best_response(problem, M - 1e-5 * direction)
        ) / 2e-5
        direction, eigenvalue = pushed, float(jnp.sum(pushed * direction))
    assert eigenvalue < -2

    gradient = central_differences(lambda P: pc.expected_cost(problem, P, deployed=M), M, 1e-2)
    elsewhere = central_differences(lambda P: pc.expected_cost(problem, P, deployed=M), M + 0.1, 1e-2)
    assert np.abs(gradient).max() < 1e-9 * np.abs(elsewhere).max()


def test_stable_point_is_the_same_from_every_start_when_there_is_one():
    problem = strongly_performative()
    reference = pc.solve(problem, SOLVER).M
    for seed in range(4):
        assert_close(pc.solve(problem, SOLVER, normal(seed, 2, 2, 3)).M, reference, 1e-8)


def test_stable_point_is_one_of_the_fixed_points_when_a_bounded_set_has_several():
    problem = performative_prediction(1.5, feasible_set=pc.FrobeniusBall(30.0))
    found = set()
    for start in (-30.0, -26.0, -20.5, 0.0, 29.0):
        solution = pc.solve(problem, SOLVER, [[[start]]])
        assert float(pc.residual(problem, solution.M)) <= 1e-11
        found.add(round(float(solution.M[0, 0, 0]), 8))
    assert found <= {-30.0, -20.0, 30.0} and len(found) >= 2


# --- a recorded disturbance: the best disturbance-action policy in hindsight -----------------------------------------

HORIZON, MEMORY, SIZES = 9, 2, (2, 3)
A, B, K = 0.4 * normal(1, 3, 3), normal(2, 3, 2), 0.2 * normal(3, 2, 3)
Q, R, START = np.diag([1.0, 2.0, 0.5]), np.diag([0.3, 1.0]), np.array([1.0, -1.0, 0.5])


def recorded(values, feasible_set=None) -> pc.PerformativeProblem:
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=HORIZON,
        noise=pc.Sequence(values),
        cost=pc.QuadraticCost(Q, R),
        memory=MEMORY,
        gain=K,
        feasible_set=feasible_set,
        initial_state=START,
    )


def in_hindsight(values, row_total=None) -> tuple[np.ndarray, bool]:
    """The policy of least norm among the best on the record, by least squares in NumPy, and whether it is alone."""
    dynamics, inputs, gain = np.asarray(A), np.asarray(B), np.asarray(K)

    def weighted_path(flat: np.ndarray) -> np.ndarray:
        M = flat.reshape(MEMORY, *SIZES)
        x, parts = START, []
        for t in range(HORIZON + 1):
            u = -gain @ x + sum(M[i - 1] @ values[t - i] for i in range(1, MEMORY + 1) if t >= i)
            parts += [np.sqrt(Q) @ x, np.sqrt(R) @ u]
            if t < HORIZON:
                x = dynamics @ x + inputs @ u + values[t]
        return np.concatenate(parts)

    size = MEMORY * SIZES[0] * SIZES[1]
    offset = weighted_path(np.zeros(size))
    slopes = np.stack([weighted_path(unit) - offset for unit in np.eye(size)], axis=1)
    particular, basis = np.zeros(size), np.eye(size)
    if row_total is not None:
        sums = np.kron(np.eye(MEMORY * SIZES[0]), np.ones((1, SIZES[1])))
        particular, basis = np.full(size, row_total / SIZES[1]), scipy.linalg.null_space(sums)
    coordinates, _, rank, _ = np.linalg.lstsq(slopes @ basis, -(offset + slopes @ particular), rcond=1e-11)
    return (particular + basis @ coordinates).reshape(MEMORY, *SIZES), rank == basis.shape[1]


@pytest.mark.parametrize("row_total", [None, 0.6], ids=["unconstrained", "row sums"])
@pytest.mark.parametrize(
    ("silent", "alone"),
    [([], (True, True)), ([2], (False, True)), ([1, 2], (False, False))],
    ids=["all excited", "one silent", "two silent"],
)
def test_stable_policy_is_the_least_norm_best_in_hindsight_when_the_disturbance_is_recorded(silent, alone, row_total):
    values = np.asarray(normal(4, HORIZON, 3)).copy()
    values[:, silent] = 0
    problem = recorded(values, None if row_total is None else pc.RowSum(row_total))
    solution = pc.solve(problem, SOLVER)
    expected, unique = in_hindsight(values, row_total)
    assert unique == alone[row_total is not None]
    assert bool(solution.stats["unique"]) == unique
    assert float(solution.stats["residual"]) <= 1e-11
    assert_close(solution.M, expected, 1e-9)


# --- a singular noise covariance -------------------------------------------------------------------------------------

FACTOR = np.array([[1.0, 0.0], [0.5, 1.0], [-1.0, 0.3]])  # its range is a plane; zero-mean noise stays in it


def singular(feasible_set=None, covariance=None) -> pc.PerformativeProblem:
    return drifting(0, feasible_set, 0.0, FACTOR @ FACTOR.T if covariance is None else covariance)


@pytest.mark.parametrize("row_total", [None, 0.6], ids=["unconstrained", "row sums"])
def test_stable_policy_is_the_least_norm_best_response_when_the_covariance_is_singular(row_total):
    problem = singular(None if row_total is None else pc.RowSum(row_total))
    solution = pc.solve(problem, SOLVER)
    # Without constraint the best response does not depend on a definite covariance; a singular one lets us see only
    # its part in the plane, in which the row sums (the plane does not contain the ones) cost nothing.
    definite = pc.best_response(singular(covariance=np.eye(3)), solution.M)
    seen = scipy.linalg.orth(FACTOR).T  # (2, 3)
    rows = np.asarray(definite).reshape(-1, 3)
    conditions, values = seen, rows @ seen.T
    if row_total is not None:
        conditions = np.vstack([seen, np.ones(3)])
        values = np.hstack([values, np.full((len(rows), 1), row_total)])
    expected = np.linalg.lstsq(conditions, values.T, rcond=None)[0].T.reshape(solution.M.shape)
    assert_close(solution.M, expected, 1e-9)
    assert bool(solution.stats["unique"]) == (row_total is not None)
    assert float(pc.residual(problem, solution.M)) <= 1e-11


def test_stable_policy_is_not_called_unique_on_row_sums_when_the_covariance_has_rank_one():
    ray = np.outer(FACTOR[:, 0], FACTOR[:, 0])
    solution = pc.solve(singular(pc.RowSum(0.6), ray), SOLVER)
    assert not bool(solution.stats["unique"]) and float(solution.stats["residual"]) <= 1e-11
    # least norm: no part across both the ray and the ones
    across = scipy.linalg.null_space(np.stack([FACTOR[:, 0], np.ones(3)]))
    assert np.abs(np.asarray(solution.M) @ across).max() < 1e-9
    np.testing.assert_allclose(np.asarray(solution.M).sum(axis=-1), 0.6, rtol=1e-12)


@pytest.mark.parametrize("expands", [False, True])
def test_stable_point_of_many_parameters_matches_that_of_few(expands, monkeypatch):
    """Neither the Hessian nor Φ' is held as a matrix then, and factors are Cholesky's."""
    problem = strongly_performative(8.0) if expands else performative_prediction(0.5)
    expected = pc.solve(problem, SOLVER)
    monkeypatch.setattr(importlib.import_module("perfcontrol.response.quadratic"), "DENSE_LIMIT", 0)
    monkeypatch.setattr(importlib.import_module("perfcontrol.response.definite"), "EIGENVALUES", 0)
    monkeypatch.setattr(importlib.import_module("perfcontrol.solvers.stable_point"), "DENSE", 0)
    jax.clear_caches()
    try:
        found = pc.solve(problem, pc.StablePoint(max_steps=31))
        assert_close(found.M, expected.M, 1e-9)
        assert float(found.stats["residual"]) <= 1e-11
    finally:
        jax.clear_caches()  # programs made with these limits


def test_secant_step_ends_at_the_fixed_point_of_an_affine_response_along_its_direction():
    """Φ(M) = r M + b shrinks all along one direction alike: two points on it tell where it ends."""
    rate, shift = 0.3, np.asarray(normal(0, 1, 2, 3))
    fixed = shift / (1 - rate)
    before = np.zeros_like(shift)
    image_before = rate * before + shift
    M, image = image_before, rate * image_before + shift
    assert_close(M + secant_direction(M, image, before, image_before), fixed, 1e-12)
    assert_close(secant_direction(before, image_before, before, image_before), shift, 1e-12)  # no step seen yet
