"""Noise whose law depends on the deployed policy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.oracles.enumeration import enumerate_cost
from tests.tools import assert_close, assert_refused, normal

T, H, N, M_ = 4, 2, 2, 2  # horizon, memory, states, inputs
A, B = 0.5 * normal(1, N, N), normal(2, N, M_)
DIRECTIONS = 0.3 * normal(3, 1, N, N + M_)


def law(M, strength):
    """Mean and spread of the noise move with the policy."""
    return pc.Rademacher(1 + strength * jnp.sum(M**2) * jnp.ones(N), mean=strength * M[0].sum(axis=0))


def scale(M, strength):
    return 0.5 + strength * jnp.sum(M**2)[None]


def problem(noise=None, perturbed=True, **kwargs):
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=T,
        memory=H,
        noise=pc.Function(law, 0.4) if noise is None else noise,
        cost=pc.QuadraticCost(np.eye(N), 0.5 * np.eye(M_), state_target=[1.0, 0.0]),
        perturbation=pc.DirectionalPerturbation(DIRECTIONS, pc.Function(scale, 0.3)) if perturbed else None,
        initial_state=[1.0, -1.0],
        **kwargs,
    )


M, DEPLOYED = 0.3 * normal(4, H, M_, N), 0.3 * normal(5, H, M_, N)


def test_cost_and_gradient_match_enumeration_under_the_deployed_law():
    lifted = np.asarray(DEPLOYED)
    spread, mean = 1 + 0.4 * np.sum(lifted**2), 0.4 * lifted[0].sum(axis=0)
    atoms = mean + spread * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    size = (0.5 + 0.3 * np.sum(lifted**2)) * np.asarray(DIRECTIONS[0])
    expected = enumerate_cost(
        A=np.broadcast_to(A, (T, N, N)),
        B=np.broadcast_to(B, (T, N, M_)),
        K=np.zeros((T + 1, M_, N)),
        Q=np.broadcast_to(np.eye(N), (T + 1, N, N)),
        R=np.broadcast_to(0.5 * np.eye(M_), (T + 1, M_, M_)),
        M=M,
        noise=[(atoms, np.full(4, 0.25))] * T,
        perturbations=[(np.stack([size, -size]), np.full(2, 0.5))] * T,
        initial=(np.array([[1.0, -1.0]]), np.ones(1)),
        state_target=np.broadcast_to([1.0, 0.0], (T + 1, N)),
    )
    assert_close(pc.expected_cost(problem(), M, deployed=DEPLOYED), expected[0])
    assert_close(pc.expected_gradient(problem(), M, deployed=DEPLOYED), expected[1])
    assert_close(pc.expected_cost_by_moments(problem(), M, deployed=DEPLOYED), expected[0])


@pytest.mark.float32
def test_the_deployed_policy_decides_the_law_and_the_evaluated_one_does_not():
    frozen = problem(law(DEPLOYED, 0.4))
    assert_close(
        pc.expected_cost(problem(), M, deployed=DEPLOYED), pc.expected_cost(frozen, M, deployed=DEPLOYED), 1e-13, 1e-5
    )
    key = jax.random.key(1)
    for function in (pc.simulate, pc.sample_gradient):
        one = function(problem(), M, deployed=DEPLOYED, key=key, samples=3)
        two = function(frozen, M, deployed=DEPLOYED, key=key, samples=3)
        for value, reference in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
            assert_close(value, reference, 1e-13, 1e-5)
    assert_close(pc.best_response(problem(), DEPLOYED), pc.best_response(frozen, DEPLOYED), 1e-12, 1e-4)


def test_estimate_lies_within_five_standard_errors():
    exact = pc.expected_cost(problem(), M)
    estimate = pc.estimate_cost(problem(), M, key=jax.random.key(2), samples=20_000)
    assert abs(float(estimate.mean - exact)) <= 5 * float(estimate.standard_error)


@pytest.mark.parametrize("perturbed", [True, False])
def test_total_gradient_matches_differences_and_carries_the_noise(perturbed):
    built, V, step = problem(perturbed=perturbed), normal(6, H, M_, N), 1e-6
    difference = (pc.expected_cost(built, M + step * V) - pc.expected_cost(built, M - step * V)) / (2 * step)
    total = pc.expected_gradient(built, M, total=True)
    assert_close(jnp.sum(total * V), difference, 1e-7)
    assert float(jnp.linalg.norm(total - pc.expected_gradient(built, M))) > 0.1


def test_best_response_derivative_matches_differences():
    built, V, step = problem(), normal(6, H, M_, N), 1e-6
    slope = jax.jvp(lambda D: pc.best_response(built, D), (DEPLOYED,), (V,))[1]
    ends = [pc.best_response(built, DEPLOYED + sign * step * V) for sign in (1, -1)]
    assert_close(slope, (ends[0] - ends[1]) / (2 * step), 1e-6)


@pytest.mark.parametrize("feasible_set", [None, pc.FrobeniusBall(0.3), pc.RowSum(0.2)], ids=["free", "ball", "rows"])
def test_stable_point_is_its_own_best_response(feasible_set):
    """Noise with a mean that reacts makes the world performative even without perturbations."""
    built = problem(perturbed=False, feasible_set=feasible_set)
    solution = pc.solve(built, pc.StablePoint())
    assert_close(pc.best_response(built, solution.M), solution.M, 1e-9)
    assert_close(pc.solve(built, pc.RRM()).M, solution.M, 1e-8)


def test_swept_parameters_of_the_law_recompile_nothing():
    traces = []

    def counting(M, strength):
        traces.append(None)
        return law(M, strength)

    counts = []
    for strength in (0.1, 0.2, 0.3):
        built, before = problem(pc.Function(counting, strength)), len(traces)
        pc.expected_cost(built, M)
        counts.append(len(traces) - before)
    assert counts[0] > 0 and counts[1:] == [0, 0]


def test_noise_that_reacts_is_recognised():
    assert problem().noise_reacts and not problem(pc.Rademacher(1.0)).noise_reacts
    assert_close(problem().noise_under(DEPLOYED).mean, 0.4 * DEPLOYED[0].sum(axis=0))


REFUSED = {
    "an array": (lambda: problem(lambda M: M[0]), "noise", "AbstractRandomVector"),
    "dimension": (lambda: problem(lambda M: pc.Gaussian(jnp.zeros(3), jnp.eye(3))), "noise", "dimension 3"),
    "needs values": (lambda: problem(lambda M: pc.TruncatedGaussian(M[0, 0], jnp.eye(2), jnp.sum(M))), "bound", "jit"),
    "fails": (lambda: problem(lambda M: M @ jnp.zeros(5)), "noise", "policy map", "(2, 2, 2)"),
    "a class": (lambda: problem(pc.Gaussian), "noise", "policy map"),
    "steps": (lambda: problem(lambda M: pc.Sequence(jnp.ones((T + 1, 2)))), "noise", "5 time steps"),
    "values": (lambda: problem(lambda M: pc.Gaussian(M[0, 0], -jnp.eye(2))), "covariance", "semidefinite"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_reacting_noise_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
