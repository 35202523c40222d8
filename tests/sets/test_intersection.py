import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import perfcontrol as pc
from perfcontrol.sets.intersection.dykstra import split_at
from perfcontrol.sets.intersection.newton import Linearised
from perfcontrol.sets.intersection.projection import solve
from tests.contracts.feasible_set import SetContract
from tests.tools import assert_close, assert_refused, normal, tolerance

MASK = np.array([[True, True, False], [False, True, True]])


class IntersectionContract(SetContract):
    support_tolerance = 1e-8  # what an intersection promises
    measured = False


class TestRowSumAndBox(IntersectionContract):
    def feasible_set(self):
        return pc.Intersection([pc.Box(0.0, 0.6), pc.RowSum(1.0)])

    def constraints(self, M):
        return [cp.sum(lag, axis=1) == 1 for lag in M] + [lag >= 0 for lag in M] + [lag <= 0.6 for lag in M]


class TestRowSumAndSupport(IntersectionContract):
    """Affine: one Newton step is exact."""

    def feasible_set(self):
        return pc.Intersection([pc.RowSum(0.5), pc.Support(MASK)])

    def constraints(self, M):
        return [cp.sum(lag, axis=1) == 0.5 for lag in M] + [cp.multiply(~MASK, lag) == 0 for lag in M]


class TestSpectralBallBoxAndRowSum(IntersectionContract):
    def feasible_set(self):
        return pc.Intersection([pc.SpectralBall(1.2), pc.Intersection([pc.Box(-0.5, 0.5), pc.RowSum(0.3)])])

    def constraints(self, M):
        sums = [cp.sum(lag, axis=1) == 0.3 for lag in M]
        return [cp.sigma_max(cp.hstack(M)) <= 1.2, *sums, *[cp.abs(lag) <= 0.5 for lag in M]]


@pytest.mark.slow
class TestTwoBalls(IntersectionContract):
    def feasible_set(self):
        return pc.Intersection((pc.SpectralBall(0.8), pc.FrobeniusBall(1.0)))

    def constraints(self, M):
        return [cp.sigma_max(cp.hstack(M)) <= 0.8, cp.norm(cp.vstack(M), "fro") <= 1.0]


@pytest.mark.float32
def test_two_unbounded_sets_that_make_a_simplex_project_and_support_like_it():
    written, simplex = pc.Intersection([pc.RowSum(1.0), pc.Box(0.0, np.inf)]), pc.RowSimplex(1.0)
    points = jnp.concatenate([scale * normal(8, 3, 2, 2, 3) for scale in (0.1, 1.0, 10.0)])
    assert_close(jax.vmap(written.project)(points), jax.vmap(simplex.project)(points), 1e-12, 1e-4)
    assert_close(written.support(points), simplex.support(points), 1e-8, 1e-2)
    assert_close(written.radius((2, 2, 3)), simplex.radius((2, 2, 3)))


def test_support_is_a_proved_upper_bound_exact_to_eight_digits():
    """max <diag(1, ½), M> over ‖M‖₂ ≤ 0.8 and ‖M‖_F ≤ 1 is at diag(0.8, 0.6)."""
    both = pc.Intersection([pc.SpectralBall(0.8), pc.FrobeniusBall(1.0)])
    excess = float(both.support(jnp.asarray([[[1.0, 0.0], [0.0, 0.5]]]))) - 1.1
    assert 0 <= excess <= 1e-8


def test_points_whose_nearest_one_is_not_found_give_no_finite_answer():
    apart = pc.Intersection([pc.RowSum(1.0), pc.Box(0.0, 0.2)])
    assert bool(jnp.all(jnp.isnan(apart.project(jnp.zeros((1, 2, 3))))))


@pytest.mark.parametrize("scale", [30.0, 3000.0])
def test_intersection_projection_satisfies_its_variational_inequality_far_outside(scale):
    """Dykstra alone would need about `scale` sweeps: here the promise of 1e-8 holds all the same."""
    feasible_set = TestSpectralBallBoxAndRowSum().feasible_set()
    inside = jax.vmap(feasible_set.project)(normal(1, 20, 2, 2, 3))
    points = scale * normal(2, 5, 2, 2, 3)
    for point, nearest in zip(points, jax.vmap(feasible_set.project)(points), strict=True):
        assert all(bool(member.contains(nearest, 1e-8)) for member in feasible_set.sets)
        gaps = jnp.sum((point - nearest) * (inside - nearest), axis=(1, 2, 3))
        assert float(jnp.max(gaps)) <= 1e-8 * scale


def test_dykstra_alone_matches_the_one_threshold_of_each_row():
    """As above the size limit for Newton steps. Rows in a box with a given sum: clip(y - threshold), by bisection."""
    feasible_set = pc.Intersection([pc.RowSum(0.5), pc.Box(-0.1, 0.4)])
    for seed in (3, 4, 5):
        M = np.asarray(2 * normal(seed, 1, 2, 3))
        expected = np.zeros_like(M)
        for index in np.ndindex(1, 2):
            row = M[index]
            threshold = scipy.optimize.brentq(
                lambda t, row=row: np.clip(row - t, -0.1, 0.4).sum() - 0.5, row.min() - 1, row.max() + 1, xtol=1e-15
            )
            expected[index] = np.clip(row - threshold, -0.1, 0.4)
        alone = solve(feasible_set.sets, jnp.asarray(M), newton=False)
        assert_close(alone.x.reshape(M.shape), expected, 1e-8)
        assert_close(feasible_set.project(jnp.asarray(M)), expected, 1e-12)


def test_intersection_projection_differentiates_in_the_parameters_of_its_sets():
    M, step = 2 * normal(4, 2, 2, 3), 1e-6

    def moved(radius, total):
        return jnp.sum(pc.Intersection([pc.SpectralBall(radius), pc.RowSum(total)]).project(M) * M)

    for argnum in (0, 1):
        ends = [
            jax.jit(moved)(*(v + sign * step * (i == argnum) for i, v in enumerate((1.0, 0.4)))) for sign in (1, -1)
        ]
        assert_close(jax.grad(moved, argnum)(1.0, 0.4), (ends[0] - ends[1]) / (2 * step), 1e-7)


def test_intersection_projects_under_jit_of_the_set_without_recompiling():
    traces = []

    @jax.jit
    def project(radius, M):
        traces.append(None)
        return pc.Intersection([pc.FrobeniusBall(radius), pc.RowSum(0.2)]).project(M)

    M = normal(5, 1, 2, 2)
    for radius in (0.5, 1.0, 2.0):
        expected = pc.Intersection([pc.FrobeniusBall(radius), pc.RowSum(0.2)]).project(M)
        assert_close(project(radius, M), expected, 1e-12, 1e-5)
    assert len(traces) == 1


@pytest.mark.float32
def test_intersection_of_one_set_is_that_set():
    ball, M = pc.FrobeniusBall(0.5), normal(6, 1, 2, 3)
    alone = pc.Intersection([ball])
    assert_close(alone.project(M), ball.project(M), 0, 0)
    assert_close(alone.support(M), ball.support(M), 0, 0)


def test_intersection_keeps_what_its_sets_know():
    both = pc.Intersection([pc.Box(0.0, 2.0), pc.RowSum(1.0)])
    assert both.nonnegative and float(both.row_total) == 1 and not both.affine
    assert float(both.radius((2, 2, 3))) == pytest.approx(2.0)  # four rows of sum one
    assert pc.Intersection([pc.RowSum(1.0), pc.Support(MASK)]).affine


@pytest.mark.float32
def test_best_response_on_an_intersection_equals_that_on_the_same_set_written_as_one():
    from tests.solvers.problems import drifting

    deployed = pc.RowSimplex(0.5).project(normal(7, 2, 2, 3))
    expected = pc.best_response(drifting(0, pc.RowSimplex(0.5)), deployed)
    written = pc.Intersection([pc.RowSum(0.5), pc.Box(0.0, 9.0)])
    assert_close(pc.best_response(drifting(0, written), deployed), expected, tolerance(1e-9, 1e-3))


REFUSED = {
    "row sums against a box": (
        lambda: pc.Intersection([pc.RowSum(1.0), pc.Box(0.0, 0.2)]).check((1, 2, 3)),
        "sets",
        "empty",
    ),
    "ball against row sums": (
        lambda: pc.Intersection([pc.FrobeniusBall(0.1), pc.RowSum(5.0)]).check((1, 2, 2)),
        "sets",
        "empty",
    ),
    "boxes apart, at once": (
        lambda: pc.Intersection([pc.Box(np.zeros((1, 2, 2)), 1.0), pc.Box(2.0, 3.0)]),
        "sets",
        "empty",
    ),
    "two totals": (lambda: pc.Intersection([pc.RowSum(1.0), pc.RowSum(2.0)]).check((1, 2, 2)), "sets", "empty"),
    "no set": (lambda: pc.Intersection([]), "sets", "at least one"),
    "not a list": (lambda: pc.Intersection(pc.RowSum(1.0)), "sets", "sequence"),
    "misfit of a member": (
        lambda: pc.Intersection([pc.Support(MASK), pc.RowSum(1.0)]).check((1, 2, 2)),
        "mask",
        "(2, 3)",
    ),
    "when the problem is built": (
        lambda: _problem(pc.Intersection([pc.RowSum(1.0), pc.Box(0.0, 0.2)])),
        "sets",
        "empty",
    ),
}


def _problem(feasible_set):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(np.eye(2), np.eye(2)),
        horizon=3,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(np.eye(2), np.eye(2)),
        feasible_set=feasible_set,
    )


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_intersection_is_refused_with_a_four_part_error(case):
    assert_refused(*case)


def test_newton_step_solves_the_linearised_equations_of_the_projection():
    """dx = J_i (dx + dp_i) + e_i and dx + Σ dp_i = dy as one dense system, the J_i known by hand."""
    sets, shape, size = (pc.Box(0.0, 0.6), pc.RowSum(1.0)), (1, 1, 4), 4
    x = jnp.array([-0.2, 0.1, 0.3, 0.9])  # the first and the last beyond the box
    split = split_at(sets, x, jnp.zeros((2, size)), shape)
    slopes = [np.diag([0.0, 1.0, 1.0, 0.0]), np.eye(size) - np.ones((size, size)) / size]
    errors, dy = np.asarray(normal(30, 2, size)), np.asarray(normal(31, size))
    eye, zero = np.eye(size), np.zeros((size, size))
    system = np.block([[eye - slopes[0], -slopes[0], zero], [eye - slopes[1], zero, -slopes[1]], [eye, eye, eye]])
    right = np.concatenate([errors[0], errors[1], dy])
    known = np.linalg.lstsq(system, right, rcond=None)[0]
    assert_close(system @ known, right, 1e-12, 1e-5)
    assert_close(Linearised(sets, split, shape).move(jnp.asarray(errors), jnp.asarray(dy)), known[:size], 1e-9, 1e-3)
