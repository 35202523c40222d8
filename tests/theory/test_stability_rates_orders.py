"""Strong stability, gain design, step sizes and error bounds, propositions, sensitivities, orders, reports."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import perfcontrol as pc
from perfcontrol.theory import order_by_bound, sensitivity_envelope, sum_threshold, verdict_rows
from perfcontrol.theory.orders import compare_orders
from perfcontrol.theory.rates import descent_constants
from tests.oracles.performative_prediction import squared_errors
from tests.theory.problems import prediction_problem, random_problem

A_PUBLISHED = np.array([[0.7, 0.3, 0.2], [-0.2, 0.4, 0.5], [-0.4, 0.2, -0.3]])
B_PUBLISHED = np.array([[0.5, -0.3], [0.8, 0.3], [0.1, 0.9]])
DIRECTION = 0.1 * np.array([[2.0, 9.0, -6.0], [9.0, 9.0, 4.0], [-9.0, -2.0, 5.0]])
GAIN = -np.array([[-0.2130622, -0.34520195, -0.33427461], [0.39663286, -0.0863928, 0.14257925]])


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), radius=st.floats(0.05, 0.99), skew=st.floats(0, 5))
def test_strong_stability_constants_satisfy_their_definition(seed, n, radius, skew):
    r = np.random.default_rng(seed)
    A = r.standard_normal((n, n))
    tilt = np.eye(n) + skew * np.triu(r.standard_normal((n, n)), 1)
    A = tilt @ A @ np.linalg.inv(tilt)
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    B, K = r.standard_normal((n, 2)), r.standard_normal((2, n))
    found = pc.strong_stability(pc.LinearSystem(A + B @ K, B), K, perturbation_bound=0.01)
    assert found.verified and found.reason == ""
    scale = np.linalg.norm(A, 2)
    np.testing.assert_allclose(found.Q @ found.L @ np.linalg.inv(found.Q), A, atol=1e-7 * max(1, scale))
    for norm in (np.linalg.norm(found.Q, 2), np.linalg.norm(np.linalg.inv(found.Q), 2), np.linalg.norm(K, 2)):
        assert norm <= found.kappa * (1 + 1e-9)
    assert np.linalg.norm(found.L, 2) <= 1 - found.gamma + 1e-9 and 0 < found.gamma <= 1 and found.kappa >= 1
    assert found.almost_surely is bool(found.factors.max() < 1)
    power = np.eye(n)
    for t in range(1, 30):
        power = power @ A
        assert np.linalg.norm(power, 2) <= found.kappa**2 * (1 - found.gamma) ** t * (1 + 1e-6) + 1e-12


def test_strong_stability_searches_the_rate_for_the_objective_it_is_given():
    A = np.array([[0.5, 3.0], [0.0, 0.6]])
    system, K = pc.LinearSystem(A, np.eye(2)), np.zeros((2, 2))
    slow = pc.strong_stability(system, K, objective=lambda s: s.kappa)
    fast = pc.strong_stability(system, K, objective=lambda s: -s.gamma)
    assert slow.kappa < fast.kappa and slow.gamma < fast.gamma


def test_stock_dynamics_are_not_strongly_stable_and_the_reason_is_said():
    problem = pc.experiments.stock_market("ascending", 1.0)
    found = pc.strong_stability(problem.system, problem.gain)
    assert not found.verified and "spectral radius 1" in found.reason


def test_strong_stability_of_a_time_varying_system_uses_one_transform():
    A = np.stack([0.5 * np.eye(2), [[0.4, 0.2], [0.0, 0.6]]])
    found = pc.strong_stability(pc.LinearSystem(A, np.eye(2)), np.zeros((2, 2)))
    assert found.verified and found.L.shape == (2, 2, 2)
    np.testing.assert_allclose(found.Q @ found.L @ np.linalg.inv(found.Q), A, atol=1e-10)


def test_strong_stability_refuses_bad_input():
    system = pc.LinearSystem(0.5 * np.eye(2), np.ones((2, 1)))
    with pytest.raises(pc.InputError, match="K"):
        pc.strong_stability(system, np.zeros((2, 2)))
    with pytest.raises(pc.InputError, match="negative"):
        pc.strong_stability(system, np.zeros((1, 2)), perturbation_bound=[-1.0])


def test_generalised_riccati_gain_matches_the_published_one():
    system = pc.LinearSystem(A_PUBLISHED, B_PUBLISHED)
    gain = pc.design_gain(system, Q=np.eye(3), R=np.eye(2), directions=[DIRECTION], variances=[0.1])
    np.testing.assert_allclose(gain, GAIN, atol=1e-8)
    plain = pc.design_gain(system, Q=np.eye(3), R=np.eye(2))
    none = pc.design_gain(system, Q=np.eye(3), R=np.eye(2), directions=[DIRECTION], variances=[0.0])
    np.testing.assert_allclose(none, plain, atol=1e-9)
    horizon = pc.LinearSystem(np.broadcast_to(A_PUBLISHED, (200, 3, 3)), B_PUBLISHED)
    first = pc.design_gain(horizon, Q=np.eye(3), R=np.eye(2), directions=[DIRECTION], variances=0.1)[0]
    np.testing.assert_allclose(first, GAIN, atol=1e-8)


def test_gain_design_says_when_multiplicative_noise_is_too_strong():
    system = pc.LinearSystem(A_PUBLISHED, B_PUBLISHED)
    with pytest.raises(pc.InputError, match="mean square"):
        pc.design_gain(system, Q=np.eye(3), R=np.eye(2), directions=[10 * DIRECTION], variances=[1.0])
    with pytest.raises(pc.InputError, match="directions"):
        pc.design_gain(system, Q=np.eye(3), R=np.eye(2), variances=[1.0])
    with pytest.raises(pc.InputError, match="non-negative"):
        pc.design_gain(system, Q=np.eye(3), R=np.eye(2), directions=[DIRECTION], variances=[-1.0])


def small_reaction():
    return random_problem(0, "scalar", strength=1e-5)


def test_theorem_step_size_satisfies_both_conditions_tightly():
    problem = small_reaction()
    m, L, _, _ = descent_constants(problem)
    phi1, phi2 = pc.theorem_step_size(problem)
    assert phi2 >= 1 and phi1 / phi2 <= min(m / L**2, 1 / m) * (1 + 1e-12)
    assert phi1 / (1 + 1 / phi2) == pytest.approx(2 / m)
    pc.InverseStep(phi1, phi2)


def test_theorem_step_size_says_why_none_exists():
    with pytest.raises(pc.InputError, match=r"S = .* μ̃"):
        pc.theorem_step_size(random_problem(0, strength=5.0))
    with pytest.raises(pc.InputError, match="unbounded"):
        pc.theorem_step_size(random_problem(0, bounded=False))


def test_error_bounds_lie_above_measured_runs():
    problem = small_reaction()
    M = pc.solve(problem, pc.StablePoint()).M
    radius = float(problem.feasible_set.limit)
    start = jnp.full((1, 1, 1), radius)
    gap = float(jnp.linalg.norm(start - M))
    rrm = pc.solve(problem, pc.RRM(), start, max_steps=6, throw=False)
    for kind in ("rigorous", "global"):
        bound = pc.rrm_error_bound(problem, gap, 6, kind=kind)
        errors = np.linalg.norm(np.asarray(rrm.history - M).reshape(7, -1), axis=1)
        assert np.all(errors <= bound + 1e-12)
    step = pc.InverseStep(*pc.theorem_step_size(problem))
    keys = jax.random.split(jax.random.key(0), 64)

    def run(key):
        record = pc.solve(problem, pc.RSGD(400, step), start, key=key, record=lambda N: jnp.sum((N - M) ** 2))
        return record.history

    errors = np.asarray(jax.vmap(run)(keys)).mean(axis=0)
    recursion = pc.rsgd_error_bound(problem, step, gap**2, 400)
    closed = pc.rsgd_error_bound(problem, step, gap**2, 400, form="closed")
    assert np.all(errors <= recursion * 1.000001) and np.all(recursion <= closed * (1 + 1e-9))


def test_closed_form_bound_refuses_steps_outside_its_conditions():
    problem = small_reaction()
    with pytest.raises(pc.InputError, match="theorem_step_size"):
        pc.rsgd_error_bound(problem, 1e3, 1.0, 10, form="closed")
    with pytest.raises(pc.InputError, match="initial_error"):
        pc.rsgd_error_bound(problem, 1e-3, -1.0, 10)
    with pytest.raises(pc.InputError, match="kind"):
        pc.rrm_error_bound(problem, 1.0, 3, kind="sharp")


def test_recursion_holds_for_performative_prediction_with_its_own_constants():
    """m = 1-ε, L = 1+ε ≥ |1-ε|, V = σ²: the recursion of the docs is above the exact error."""
    epsilon, sigma = 0.5, 0.3
    steps = [0.3 / (1 + 0.01 * n) for n in range(200)]
    exact = squared_errors(steps, 4.0, 10.0, epsilon, sigma)
    bound = [exact[0]]
    for eta in steps:
        bound.append((1 - 2 * eta * (1 - epsilon) + eta**2 * (1 + epsilon) ** 2) * bound[-1] + eta**2 * sigma**2)
    assert np.all(exact <= np.array(bound) * (1 + 1e-12))


def test_propositions_agree_with_the_certificate():
    problem = random_problem(5, "wide", strength=1e-6)
    certificate = pc.certify(problem, "rigorous")
    threshold, envelope = sum_threshold(problem), sensitivity_envelope(problem)
    assert threshold.threshold == pytest.approx(certificate.rhs / certificate.weights.max())
    assert not threshold.holds or certificate.holds
    np.testing.assert_allclose(envelope.envelope, certificate.rhs / certificate.weights)
    assert not certificate.holds or envelope.holds


def test_printed_propositions_ask_for_their_regime():
    stable = random_problem(5, "scalar", strength=1e-6, growth=0.3)
    with pytest.raises(pc.InputError, match="ζ"):
        sensitivity_envelope(stable, printed=True)
    assert sum_threshold(stable, printed=True).threshold > 0


def test_the_papers_weights_always_fall_in_time_and_the_rigorous_ones_need_not():
    """ν_t does not depend on k in the paper; with x_0 = 0 the rigorous ν_{t,k} is smallest for the first steps."""
    problem = order_problem(np.full(4, 1e-3))
    assert np.all(np.diff(pc.certify(problem, "paper").weights) < 0)
    rigorous = pc.certify(problem, "rigorous").weights
    assert rigorous[0] == min(rigorous)


def test_sensitivity_estimates_agree_for_one_direction():
    """Δ = σ(M) ζ D with one direction: ε = ‖slope‖ E|ζ| ‖D‖ by every method."""
    one = np.ones((1, 1))
    slope = np.array([[0.3, -0.4]]).reshape(1, 1, 1, 2)
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * np.eye(2), np.ones((2, 1))),
        horizon=2,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(np.eye(2), one),
        perturbation=pc.DirectionalPerturbation([2 * np.eye(2)], pc.Affine([1.0], slope)),
        feasible_set=pc.FrobeniusBall(1.0),
    )
    analytic = pc.estimate_sensitivity(problem, method="analytic")
    np.testing.assert_allclose(analytic.epsilon, [1.0, 1.0])
    coupling = pc.estimate_sensitivity(problem, key=jax.random.key(0), policies=2, samples=16)
    np.testing.assert_allclose(coupling.epsilon, [1.0, 1.0], rtol=1e-9)
    assert analytic.status == "proved" and coupling.status == "estimated"


def test_transport_estimate_matches_the_exact_distance_of_two_point_laws():
    pytest.importorskip("ot")
    problem = random_problem(0, "scalar", strength=0.5)
    key = jax.random.key(0)
    found = pc.estimate_sensitivity(problem, method="transport", key=key, policies=3, samples=400, distance=1.0)
    exact = pc.estimate_sensitivity(problem, method="analytic").epsilon
    assert np.all(found.epsilon <= exact * 1.5 + 0.1) and found.epsilon.max() > 0.3 * exact.max()


def test_transport_says_which_package_is_missing(monkeypatch):
    import importlib

    def refuse(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(pc.InputError, match="POT"):
        pc.estimate_sensitivity(random_problem(0, "scalar"), method="transport", key=jax.random.key(0))


def test_sensitivity_estimates_refuse_bad_input():
    problem = random_problem(0, "scalar")
    with pytest.raises(pc.InputError, match="method"):
        pc.estimate_sensitivity(problem, method="guess")
    with pytest.raises(pc.InputError, match="key"):
        pc.estimate_sensitivity(problem)


def test_order_by_bound_is_the_best_of_all_permutations():
    import itertools

    epsilon, weights = [0.1, 0.5, 0.2, 0.9], [3.0, 1.0, 2.0, 0.5]
    sums = [np.dot(p, weights) for p in itertools.permutations(epsilon)]
    verdict = order_by_bound(epsilon, weights)
    assert verdict.best_value == pytest.approx(min(sums)) and verdict.worst_value == pytest.approx(max(sums))
    assert verdict.best @ np.array(weights) == pytest.approx(min(sums))


def order_problem(epsilon):
    """Scalar, K = 0: Δ_t = (0.1 + ε_t M) ζ_t."""
    one = np.ones((1, 1))
    T = len(epsilon)
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.8 * one, one),
        horizon=T,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(one, one),
        perturbation=pc.DirectionalPerturbation(
            [one], pc.Affine(np.full((T, 1), 0.1), np.asarray(epsilon).reshape(T, 1, 1, 1, 1))
        ),
        feasible_set=pc.FrobeniusBall(2.0),
    )


def test_small_early_sensitivities_are_preferred_by_the_bound_and_not_always_by_the_problem():
    epsilon = np.array([0.01, 0.02, 0.3, 0.4])
    weights = pc.certify(order_problem(epsilon), "paper").weights
    np.testing.assert_allclose(order_by_bound(epsilon, weights).best, np.sort(epsilon))
    rows = compare_orders(order_problem, epsilon, orders=[[0, 1, 2, 3], [3, 2, 1, 0], [2, 3, 0, 1]])
    # Δ_0 and Δ_1 act on states that the policy has not reached: the exact rate is smallest with the large ones there.
    assert rows[0]["order"].tolist() in ([3, 2, 1, 0], [2, 3, 0, 1])
    assert rows[-1]["order"].tolist() == [0, 1, 2, 3]
    with pytest.raises(pc.InputError, match="permutations"):
        compare_orders(order_problem, epsilon, orders=[[0, 0, 1, 2]])


def test_reports_are_plain_data():
    rows = verdict_rows(prediction_problem(0.5), ("paper", "rigorous", "global"))
    assert json.loads(json.dumps(rows)) == rows
    assert [row["kind"] for row in rows] == ["paper", "rigorous", "global"]
    assert all(row["applicable"] is False and row["missing"] for row in rows)
