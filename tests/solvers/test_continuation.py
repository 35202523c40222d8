"""Continuation against published fixed points, the exact variational inequality, and problems that stop Newton."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.solver import SolverContract
from tests.oracles.performative_prediction import stable_decision
from tests.solvers.problems import MEAN, drifting, performative_prediction, strongly_performative
from tests.tools import assert_close, assert_refused, normal

SOLVER = pc.Continuation()


class TestContinuation(SolverContract):
    close = (1e-9, 2e-3)

    def solver(self):
        return SOLVER

    @pytest.mark.float32
    def test_continuation_and_stable_point_agree(self):
        for problem, solution in zip(self.problems, self.singles, strict=True):
            assert_close(solution.M, pc.solve(problem, pc.StablePoint()).M, 1e-9, 1e-3)
            assert float(solution.stats["level"]) == pytest.approx(1.0)
            assert bool(solution.stats["unique"])


def test_first_step_stays_at_the_anchor_and_finds_the_scale_of_the_curve():
    problem = drifting(0)
    began = SOLVER.init(problem, np.zeros(problem.policy_shape))
    state = SOLVER.step(problem, began, None)
    assert float(began.own.scale) == 0 < float(state.own.scale)
    assert float(state.own.level) == 0 < float(state.own.length)
    assert float(SOLVER.step(problem, state, None).own.level) > 0


def reacting_mean(seed: int, strength: float, feasible_set=None) -> pc.PerformativeProblem:
    """A mean that reacts so strongly that the best response jumps about on a ball's surface and through it."""
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.4 * normal(seed, 3, 3), normal(seed + 1, 3, 2)),
        horizon=6,
        noise=pc.Rademacher([0.5, 0.8, 0.3]),
        cost=pc.QuadraticCost(np.eye(3), np.diag([0.05, 2.0])),
        gain=0.3 * normal(seed + 2, 2, 3),
        perturbation=pc.DirectionalPerturbation(
            normal(seed + 3, 1, 3, 3),
            pc.Affine([0.1], 0.1 * normal(seed + 4, 1, 1, 2, 3)),
            mean=pc.Affine(np.zeros((3, 3)), strength * normal(seed + 5, 3, 3, 1, 2, 3)),
        ),
        feasible_set=pc.FrobeniusBall(1.0) if feasible_set is None else feasible_set,
        initial_state=normal(seed + 6, 3),
    )


def violation(problem: pc.PerformativeProblem, M: jax.Array) -> float:
    """max over the ball of <g, M - N>, relative: zero just where M is its own best response; g by differences."""

    def cost(N):
        return pc.expected_cost(problem, N, deployed=M)

    step = 1e-4
    basis = jnp.eye(M.size).reshape(-1, *M.shape)
    g = jnp.stack([(cost(M + step * e) - cost(M - step * e)) / (2 * step) for e in basis])
    radius = float(problem.feasible_set.limit)
    return float((g @ M.reshape(-1) + radius * jnp.linalg.norm(g)) / (1 + radius * jnp.linalg.norm(g)))


@pytest.mark.slow
def test_continuation_satisfies_the_variational_inequality_where_the_mean_reacts_strongly():
    lost = 0
    for seed in range(0, 60, 3):
        problem = reacting_mean(seed, 1.5)
        solution = pc.solve(problem, SOLVER, throw=False)
        assert solution.result == pc.Result.success, seed
        assert float(solution.stats["residual"]) <= 1e-11
        assert violation(problem, solution.M) <= 1e-6, seed
        alone = pc.solve(problem, pc.StablePoint(rescue=False), throw=False).result == pc.Result.success
        stable = pc.solve(problem, pc.StablePoint())
        assert float(stable.stats["residual"]) <= 1e-11 and bool(stable.stats["rescued"]) == (not alone), seed
        lost += not alone
    assert lost > 0, "these problems should be too hard for Newton's method alone"


SLOW = [pytest.param(seed, marks=pytest.mark.slow) for seed in (12, 48)]


@pytest.mark.parametrize("seed", [18, *SLOW])
def test_continuation_passes_the_kinks_of_a_box_where_the_curve_turns_sharply(seed):
    """At 12 and 48 no step along the tangent of the near side meets the curve beyond the kink."""
    limit = 0.3
    problem = reacting_mean(seed, 1.5, pc.Box(-limit, limit))
    solution = pc.solve(problem, SOLVER)
    assert int(solution.steps) > 100  # many kinks on the way
    assert 0 < int(jnp.sum(jnp.abs(solution.M) >= limit)) < solution.M.size
    g = pc.expected_gradient(problem, solution.M)
    # The variational inequality of a box, entry by entry.
    assert float(jnp.sum(g * solution.M + limit * jnp.abs(g))) <= 1e-9 * float(jnp.sum(jnp.abs(g)))


@pytest.mark.parametrize("sensitivity", [0.9, 1.5, -3.0, -40.0, 0.0])
def test_continuation_ends_at_a_published_fixed_point_of_the_clipped_response(sensitivity):
    radius = 25.0
    problem = performative_prediction(sensitivity, feasible_set=pc.FrobeniusBall(radius))
    found = float(pc.solve(problem, SOLVER).M.reshape(()))
    candidates = (-radius, stable_decision(MEAN, sensitivity), radius)
    response = {value: np.clip(MEAN + sensitivity * value, -radius, radius) for value in candidates}
    fixed = [value for value in candidates if response[value] == pytest.approx(value)]
    assert min(abs(found - value) for value in fixed) <= 1e-9 * radius


def test_continuation_finds_what_repeated_minimisation_cycles_about():
    problem = strongly_performative()
    assert pc.solve(problem, pc.RRM(), throw=False).result == pc.Result.not_converged
    assert_close(pc.solve(problem, SOLVER).M, pc.solve(problem, pc.StablePoint()).M, 1e-9)


@pytest.mark.slow
def test_continuation_does_not_claim_what_is_not_there():
    solution = pc.solve(performative_prediction(1.0), SOLVER, throw=False)
    assert solution.result == pc.Result.not_converged
    assert bool(jnp.all(jnp.isfinite(solution.M)))


@pytest.mark.parametrize("case", ["cost", "tolerance", "size", "steps"])
def test_continuation_is_refused_with_a_four_part_error(case):
    if case == "steps":
        assert_refused(lambda: pc.Continuation(max_steps=0), "max_steps")
        return
    problem, solver = drifting(), SOLVER
    if case == "tolerance":
        solver = pc.Continuation(tolerance=1e-30)
    if case == "size":
        problem = pc.PerformativeProblem(
            system=pc.LinearSystem(0.1 * np.eye(50), np.eye(50)),
            horizon=3,
            noise=pc.Rademacher(np.ones(50)),
            cost=pc.QuadraticCost(np.eye(50), np.eye(50)),
        )
    if case == "cost":
        problem = pc.PerformativeProblem(
            system=pc.LinearSystem([[0.1]], [[1.0]]),
            horizon=3,
            noise=pc.Rademacher([1.0]),
            cost=pc.ConvexCost(lambda t, x, u: jnp.sum(x**2) + jnp.sum(u**2)),
        )
    assert_refused(lambda: pc.solve(problem, solver), "problem" if case == "size" else case)
