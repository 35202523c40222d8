"""Decisions from a fit: stable policies and costs of the ensemble against closed forms, shares, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.identification.decision import decide
from tests.identification.worlds import World, small_policies, small_world
from tests.tools import assert_close, assert_refused

SQUARE = World(
    A=np.array([[0.6, 0.2], [-0.1, 0.5]]),
    B=np.array([[1.0, 0.2], [0.0, 0.8]]),
    K=np.array([[0.2, 0.0], [0.0, 0.1]]),
    noise=np.array([[0.3, 0.1], [0.1, 0.2]]),
    directions=np.array([[[0.6, 0.0], [0.3, 0.7]]]),
    scale=lambda M: np.array([0.2 + 0.4 * np.linalg.norm(M)]),
)
POLICIES = [np.zeros((1, 2, 2)), np.array([[[0.5, 0.0], [0.2, -0.4]]]), np.array([[[0.0, 0.4], [-0.3, 0.3]]])]
FIT = pc.fit(
    pc.Logs(*SQUARE.logs(0, POLICIES, 20, 10)),
    SQUARE.K,
    directions=SQUARE.directions,
    reaction={"mean": "constant", "scale": "norm"},
)
FREE_INPUTS = pc.QuadraticCost(np.eye(2), np.zeros((2, 2)))  # R = 0: M does not feel the perturbations
KEY = jax.random.key(0)


def quantiles(values: np.ndarray, level: float) -> np.ndarray:
    """By sorting and interpolating between neighbours."""
    ordered = np.sort(values, axis=0)
    place = np.array([(1 - level) / 2, (1 + level) / 2]) * (len(values) - 1)
    below = np.floor(place).astype(int)
    part = (place - below).reshape(-1, *[1] * (values.ndim - 1))
    return ordered[below] * (1 - part) + ordered[np.minimum(below + 1, len(values) - 1)] * part


def test_decision_matches_the_closed_form_where_inputs_are_free() -> None:
    made = FIT.decide(40, key=KEY, cost=FREE_INPUTS, horizon=2, initial_state=0.0, level=0.9)
    stack = FIT.ensemble(40, key=KEY, cost=FREE_INPUTS, horizon=2, initial_state=0.0)
    parts = (stack.system.A, stack.system.B, stack.noise.mean, stack.noise.covariance)
    policies = np.stack([optimum(*map(np.asarray, member)) for member in zip(*parts, strict=True)])
    assert_close(made.policies, policies, 1e-8)
    low, high = quantiles(policies, 0.9)
    assert_close(made.policy.low, low, 1e-8)
    assert_close(made.policy.high, high, 1e-8)
    fitted = (FIT.A.mean, FIT.B.mean, FIT.noise_mean.mean, FIT.noise_covariance.mean)
    assert_close(made.M, optimum(*map(np.asarray, fitted)), 1e-8)

    members = [jax.tree.map(lambda leaf, i=i: leaf[i], stack) for i in range(40)]
    own = np.array([two_steps(member, M) for member, M in zip(members, policies, strict=True)])
    assert_close(made.costs, own, 1e-8)
    assert_close(np.array([made.cost.low, made.cost.high]), quantiles(own, 0.9), 1e-8)
    deployed = np.array([two_steps(member, made.M) for member in members])
    assert_close(np.array([made.deployed_cost.low, made.deployed_cost.high]), quantiles(deployed, 0.9), 1e-8)
    assert made.solved == 1 and made.certified == 1 and made.certificate.holds


def optimum(A: np.ndarray, B: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """The minimiser of E |(A - BK + B M) w_0 + w_1|², (1, m, n)."""
    both = np.outer(mean, mean)
    return -np.linalg.solve(B, A - B @ SQUARE.K + both @ np.linalg.inv(covariance + both))[None]


def two_steps(member: pc.PerformativeProblem, M: np.ndarray) -> float:
    """E |x_1|² + |x_2|² for x_1 = w_0, x_2 = (A - BK + B M + Δ) w_0 + w_1."""
    A, B, mean = (np.asarray(part) for part in (member.system.A, member.system.B, member.noise.mean))
    W = np.asarray(member.noise.covariance) + np.outer(mean, mean)
    F, D = A - B @ SQUARE.K + B @ M[0], SQUARE.directions[0]
    sigma = float(member.perturbation.scales(jnp.asarray(M), 2)[0, 0])
    return float(np.trace(2 * W + F @ W @ F.T + sigma**2 * D @ W @ D.T) + 2 * mean @ F @ mean)


def predictive(epsilon: float, mu: float = 1.0) -> pc.PerformativeProblem:
    """Performative prediction: x_2 = z - M, E z = μ + ε M', so that M = μ / (1 - ε); costs half the variance there."""
    scale = jnp.asarray([0.3])
    mean = pc.Affine([[mu - 1.0]], [[[[[epsilon]]]]])
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.0]], [[-1.0]]),
        horizon=2,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost(np.array([0.0, 0.0, 0.5]).reshape(3, 1, 1), np.zeros((1, 1))),
        perturbation=pc.DirectionalPerturbation([[[1.0]]], scale, mean),
    )


def test_shares_count_the_members_for_which_repeated_minimisation_converges() -> None:
    reactions = np.array([-0.5, 0.1, 0.3, 0.5, 0.6, 1.2, 1.5, -2.0])  # it converges where |ε| < 1
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[predictive(e) for e in reactions])
    made = decide(predictive(0.2), stack, pc.RRM(), "sharp", 0.5, None)
    assert made.solved == made.certified == 5 / 8
    found = 1 / (1 - reactions[:5])
    assert_close(made.policies[:5].ravel(), found, 1e-8)
    assert np.isnan(made.policies[5:]).all() and np.isnan(made.costs[5:]).all()
    assert_close(made.M, np.full((1, 1, 1), 1.25), 1e-8)
    low, high = quantiles(found, 0.5)
    assert_close(np.array([made.policy.low, made.policy.high]).ravel(), np.array([low, high]), 1e-8)
    assert_close(made.costs[:5], np.full(5, 0.045), 1e-8)
    assert "62.5 % have a stable policy" in str(made) and "with a stable policy alone" in str(made)


def test_certificate_is_counted_where_it_holds_only() -> None:
    reactions = np.array([0.1, 0.5, 1.2, 1.5])  # Newton's method finds all four policies; two repel
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[predictive(e) for e in reactions])
    made = decide(predictive(0.2), stack, pc.StablePoint(), "sharp", 0.5, None)
    assert made.solved == 1 and made.certified == 0.5
    assert_close(made.policies.ravel(), 1 / (1 - reactions), 1e-8)


def test_ensemble_resamples_the_initial_state_of_its_episodes() -> None:
    stack = FIT.ensemble(300, key=KEY, cost=FREE_INPUTS, horizon=2)
    first = np.stack([x[0] for x in FIT.logs.x])
    means = np.asarray(stack.initial_state.mean)
    assert_close(means.mean(axis=0), first.mean(axis=0), 0.1)
    expected = first.std(axis=0) / np.sqrt(len(first))
    assert np.all(np.abs(means.std(axis=0) / expected - 1) < 0.2)
    single = FIT.problem(cost=FREE_INPUTS, horizon=2)
    assert_close(single.initial_state.covariance, np.cov(first, rowvar=False, ddof=0), 1e-10)
    fixed = FIT.ensemble(3, key=KEY, cost=FREE_INPUTS, horizon=2, initial_state=np.ones(2))
    assert np.array_equal(fixed.initial_state.mean, np.ones((3, 2)))


def test_a_start_that_never_varied_is_a_constant() -> None:
    world = small_world().but(start=0.0)
    fit = pc.fit(pc.Logs(*world.logs(1, small_policies()[:3], 15, 10)), world.K, directions=world.directions)
    problem = fit.problem(cost=pc.QuadraticCost(np.eye(2), np.eye(1)), horizon=5)
    assert isinstance(problem.initial_state, pc.Constant) and not np.any(problem.initial_state.mean)


def wrong(**options: object) -> pc.Decision:
    return FIT.decide(**({"k": 3, "key": KEY, "cost": FREE_INPUTS, "horizon": 2} | options))


WRONG = {
    "no members": (lambda: wrong(k=0), "k", "at least 1"),
    "no key": (lambda: wrong(key=None), "key", "random key"),
    "level in per cent": (lambda: wrong(level=95), "level", "between 0 and 1"),
    "level that is no number": (lambda: wrong(level="high"), "level", "between 0 and 1"),
    "solver that is none": (lambda: wrong(solver="newton"), "solver", "pc.StablePoint()"),
    "unknown certificate": (lambda: wrong(certificate="golden"), "kind", "'golden'"),
    "horizon that is none": (lambda: wrong(horizon=0), "horizon", "at least 1"),
    "cost of other sizes": (lambda: wrong(cost=pc.QuadraticCost(np.eye(3), np.eye(2))), "Q", "(2, 2)"),
    "start of another size": (lambda: wrong(initial_state=np.ones(3)), "initial_state", "3"),
}


@pytest.mark.parametrize("case", WRONG)
def test_decide_refuses_with_one_clear_message(case: str) -> None:
    build, name, *words = WRONG[case]
    assert_refused(build, name, *words)


def test_no_member_with_a_stable_policy_is_refused() -> None:
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), predictive(1.5), predictive(2.0))
    assert_refused(lambda: decide(predictive(0.2), stack, pc.RRM(), "sharp", 0.5, None), "logs", "more episodes")
