"""Solvers on infinite horizons: answers, unstable worlds on the way, simulation, certificates."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import perfcontrol as pc
from tests.evaluate.endless import M, everything
from tests.solvers.problems import drifting
from tests.tools import assert_close, assert_refused, normal

F, WEIGHT, HEIGHT, WIDTH, CENTRE = 0.9, 3.0, 0.3, 0.15, -0.57


def belt(feasible_set=None) -> pc.PerformativeProblem:
    """x ← 0.9 x + u + Δx + w, u = M w_{t-1}: around M = -0.57 the world is turbulent, mean-square unstable inside."""

    def scale(M):
        return jnp.sqrt(HEIGHT) * jnp.exp(-(((M[0, 0] - CENTRE) / WIDTH) ** 2) / 2)

    return pc.PerformativeProblem(
        system=pc.LinearSystem([[F]], [[1.0]]),
        horizon=math.inf,
        noise=pc.Rademacher([1.0]),
        cost=pc.QuadraticCost([[1.0]], [[WEIGHT]]),
        perturbation=pc.DirectionalPerturbation([[[1.0]]], pc.Function(scale)),
        feasible_set=feasible_set,
    )


def belt_response(M):
    """-ΛF / (R + Λ), Λ = 1 / (1 - F² - σ²): one lag of a scalar system."""
    variance = HEIGHT * np.exp(-(((M - CENTRE) / WIDTH) ** 2))
    Lambda = 1 / (1 - F**2 - variance)
    return -Lambda * F / (WEIGHT + Lambda)


def test_stable_point_backs_off_from_unstable_worlds_where_repeated_minimisation_ends_in_one():
    problem = belt()
    start = float(belt_response(0.0))
    assert HEIGHT * np.exp(-(((start - CENTRE) / WIDTH) ** 2)) > 1 - F**2  # the first response is not to be deployed
    failed = pc.solve(problem, pc.RRM(), throw=False)
    assert failed.result == pc.Result.nonfinite
    assert_close(failed.M, [[[start]]], 1e-9)
    found = pc.solve(problem, pc.StablePoint())
    expected = scipy.optimize.brentq(lambda M: belt_response(M) - M, -0.9, -0.68, xtol=1e-14)
    assert_close(found.M, [[[expected]]], 1e-10)


def test_optimum_beyond_an_unstable_belt_is_that_of_a_fine_grid():
    """C(M; M) = Λ + 2ΛFM + (R + Λ) M²; inside the belt it is infinite."""
    M = np.linspace(-1.0, 0.5, 300_001)
    slack = 1 - F**2 - HEIGHT * np.exp(-(((M - CENTRE) / WIDTH) ** 2))
    Lambda = 1 / np.where(slack > 0, slack, np.nan)
    costs = Lambda + 2 * Lambda * F * M + (WEIGHT + Lambda) * M**2
    assert np.any(slack <= 0)
    found = pc.solve(belt(), pc.PerformativeOptimum(starts=4))
    assert_close(pc.expected_cost(belt(), found.M), np.nanmin(costs), 1e-9)
    assert abs(float(found.M[0, 0, 0]) - M[np.nanargmin(costs)]) <= 1e-5


@pytest.mark.slow
def test_optimum_has_no_total_gradient_and_costs_less_than_the_stable_policy():
    problem = everything()
    best, stable = (pc.solve(problem, solver).M for solver in (pc.PerformativeOptimum(starts=2), pc.StablePoint()))
    assert pc.expected_cost(problem, best) < pc.expected_cost(problem, stable)
    scale = jnp.linalg.norm(pc.expected_gradient(problem, stable, total=True))
    assert jnp.linalg.norm(pc.expected_gradient(problem, best, total=True)) <= 1e-8 * scale


def test_start_in_an_unstable_world_is_named_and_kept():
    problem, wild = everything(), 8 * M
    for solver in (pc.StablePoint(), pc.RRM()):
        with pytest.raises(pc.SolveError, match="mean-square stable") as caught:
            pc.solve(problem, solver, wild)
        solution = caught.value.solution
        assert solution.result == pc.Result.nonfinite
        assert_close(solution.M, wild, 0, 0)


@pytest.mark.float32
def test_solvers_agree_with_all_parts_present():
    problem = everything()
    stable = pc.solve(problem, pc.StablePoint())
    assert stable.stats["unique"]
    for solver in (pc.RRM(), pc.Continuation()):
        assert_close(pc.solve(problem, solver).M, stable.M, 1e-9, 1e-3)
    descended = pc.solve(problem, pc.RSGD(800, 0.02, gradient=pc.Exact()))
    assert_close(descended.M, stable.M, 1e-5, 1e-3)
    assert_close(jax.jit(lambda M0: pc.solve(problem, pc.RRM(), M0).M)(0.5 * M), stable.M, 1e-9, 1e-3)


ROWS = {
    "ball, dense": (pc.FrobeniusBall(0.3), pc.DensePerturbation(lambda M: 0.1 + 0.05 * jnp.sum(M**2), law="sphere")),
    "rows, finite": (
        pc.RowSum(0.1),
        pc.FinitePerturbation(0.3 * normal(1, 2, 2, 2), lambda M: jax.nn.softmax(M.reshape(-1)[:2])),
    ),
    "box, on input": (
        pc.Box(-0.1, 0.1),
        pc.DirectionalPerturbation(0.2 * normal(2, 1, 2, 4), lambda M: 1 + jnp.sum(M**2)[None]),
    ),
    "spectral, none": (pc.SpectralBall(0.2), None),
}


@pytest.mark.parametrize("name", ROWS)
def test_stable_policies_of_sets_and_families_are_fixed_points(name):
    feasible_set, family = ROWS[name]
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0.3 * normal(3, 2, 2), np.eye(2) + 0.3 * normal(4, 2, 2)),
        horizon=math.inf,
        memory=2,
        noise=lambda M: pc.Gaussian(jnp.stack([0.2 * jnp.sum(M**2), 0.1 * jnp.sum(M)]), np.diag([1.0, 0.5])),
        cost=pc.QuadraticCost(np.eye(2), 0.5 * np.eye(2), state_target=[0.3, -0.2]),
        perturbation=family,
        feasible_set=feasible_set,
    )
    stable = pc.solve(problem, pc.StablePoint())
    assert pc.residual(problem, stable.M) <= 1e-10
    assert_close(pc.solve(problem, pc.RRM()).M, stable.M, 1e-8)


def test_rsgd_on_truncated_paths_takes_the_steps_of_the_truncated_problem():
    endless, T, key = everything(), 30, jax.random.key(2)
    solution = pc.solve(endless, pc.RSGD(20, 0.02, truncation=T), key=key)
    finite = pc.solve(endless.truncated(T), pc.RSGD(20, 0.02 / (T + 1)), key=key)
    assert_close(solution.M, finite.M, 1e-10)


def test_rsgd_asks_for_a_truncation_where_it_simulates_and_only_there():
    key = jax.random.key(0)
    assert_refused(lambda: pc.solve(everything(), pc.RSGD(3, 0.1), key=key), "truncation", "None")
    assert_refused(lambda: pc.solve(drifting(), pc.RSGD(3, 0.1, truncation=5), key=key), "truncation", "6")
    assert_refused(lambda: pc.RSGD(3, 0.1, truncation=0), "truncation")


def test_sharp_certificate_matches_differences_of_the_best_response():
    problem = everything()
    certificate = pc.certify(problem, "sharp", pairs=2)
    assert certificate.holds and certificate.exists
    step, stable = 1e-5, certificate.values["M"]
    columns = [
        (pc.best_response(problem, stable + V) - pc.best_response(problem, stable - V)).ravel() / (2 * step)
        for V in step * np.eye(stable.size).reshape(-1, *stable.shape)
    ]
    assert certificate.rate == pytest.approx(np.abs(np.linalg.eigvals(np.stack(columns))).max(), rel=1e-6)
    assert "problem.truncated(T)" in str(certificate)  # for the mean-square step
    unstable = pc.certify(belt(), "sharp", samples=0, pairs=8)
    assert unstable.applicable and math.isfinite(unstable.values["contraction_estimate"])


def test_other_certificates_say_that_they_need_a_finite_horizon():
    problem = everything()
    for kind in ("paper", "rigorous", "global"):
        certificate = pc.certify(problem, kind)
        assert not certificate.applicable and "truncated" in certificate.missing[0]
        assert certificate.exists is None
    for call in (pc.safe_step, pc.theorem_step_size):
        assert_refused(lambda call=call: call(problem), "problem", "truncated")
