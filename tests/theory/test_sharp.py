"""The local test, the mean-square analysis and the safe step, against closed forms and simulation."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory.local import hessian, reaction_jacobian
from perfcontrol.theory.mean_square import leading_eigenvalue
from perfcontrol.theory.sampled_jacobian import JacobianSamples
from perfcontrol.theory.sharp import contraction_estimate, local_model, mean_square_stability, safe_step
from tests.theory.problems import prediction_problem, random_problem


@pytest.mark.parametrize("sensitivity", [0.0, 0.5, 0.9, 0.999, 1.001, 1.7, -0.5, -1.4])
def test_performative_prediction_has_rate_exactly_its_sensitivity(sensitivity):
    certificate = pc.certify(prediction_problem(sensitivity), "sharp", samples=0, pairs=0)
    assert certificate.rate == pytest.approx(abs(sensitivity), abs=1e-12)
    assert certificate.holds is (abs(sensitivity) < 1)
    assert certificate.exists is True
    np.testing.assert_allclose(certificate.values["M"], 10 / (1 - sensitivity), rtol=1e-9)
    # θ - η(1-ε)(θ - θ*): stable for ε < 1 and η < 2/(1-ε), also for ε < -1 where repeated minimisation diverges
    assert certificate.values["mean_field_stable"] is (sensitivity < 1)
    if sensitivity < 1:
        assert certificate.values["mean_step"] == pytest.approx(2 / (1 - sensitivity))


def test_performative_prediction_has_no_stable_point_at_sensitivity_one():
    certificate = pc.certify(prediction_problem(1.0), "sharp", samples=0, pairs=0)
    assert certificate.exists is False and certificate.holds is False
    assert certificate.rate == pytest.approx(1.0)
    assert "No stable policy exists" in str(certificate)


def test_above_sensitivity_one_a_stable_point_exists_and_repeated_minimisation_diverges():
    problem = prediction_problem(1.3)
    certificate = pc.certify(problem, "sharp", samples=0)
    assert certificate.exists is True and certificate.holds is False
    solution = pc.solve(problem, pc.RRM(), certificate.values["M"] + 1e-3, throw=False, max_steps=50)
    assert abs(float(solution.M.squeeze()) - float(certificate.values["M"].squeeze())) > 100


def test_prediction_mean_square_analysis_matches_its_closed_form():
    """The noise of the data is additive: threshold 2/(1-ε), floor η²σ²/(1 - (1-η(1-ε))²)."""
    stability = mean_square_stability(prediction_problem(0.5, deviation=0.3), samples=64)
    assert stability.threshold_estimate == pytest.approx(4.0, rel=1e-6)
    exact = 0.5**2 * 0.3**2 / (1 - (1 - 0.5 * 0.5) ** 2)
    assert stability.error_floor(0.5) == pytest.approx(exact, rel=0.15)  # the gradient's variance is sampled
    assert stability.spectral_radius(1.0) == pytest.approx(0.25, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_derivative_of_the_best_response_matches_finite_differences_where_the_ball_is_active(seed):
    problem = random_problem(seed, strength=0.5)
    problem = eqx.tree_at(lambda p: p.feasible_set.limit, problem, jnp.asarray(0.05))
    M = problem.initial_policy()
    for _ in range(60):
        M = pc.best_response(problem, M)
    assert float(jnp.linalg.norm(M)) == pytest.approx(0.05)
    model = local_model(problem, M)
    assert model.damping is not None and model.basis.shape[1] == M.size - 1
    for column, direction in zip(model.response_jacobian.T, model.basis.T, strict=True):
        V, step = jnp.asarray(direction.reshape(M.shape)), 1e-5
        central = (pc.best_response(problem, M + step * V) - pc.best_response(problem, M - step * V)) / (2 * step)
        np.testing.assert_allclose(column, model.basis.T @ np.asarray(central).reshape(-1), atol=1e-7)


def test_unconstrained_response_jacobian_is_minus_inverse_hessian_times_reaction():
    problem = random_problem(7, bounded=False, strength=0.2)
    M = pc.solve(problem, pc.StablePoint()).M
    H, E = hessian(problem, M), reaction_jacobian(problem, M, M)
    np.testing.assert_allclose(local_model(problem, M).response_jacobian, -np.linalg.solve(H, E), atol=1e-10)
    step, V = 1e-5, jax.random.normal(jax.random.key(0), M.shape)
    difference = pc.expected_gradient(problem, M, deployed=M + step * V) - pc.expected_gradient(
        problem, M, deployed=M - step * V
    )
    np.testing.assert_allclose(
        E @ np.asarray(V).reshape(-1), np.asarray(difference).reshape(-1) / (2 * step), rtol=1e-5, atol=1e-8
    )


def enumerated_problem():
    """Scalar, T = 3, Δ and w Rademacher: 64 equally likely paths; D does not depend on the policy."""
    one = np.ones((1, 1))
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.8 * one, one),
        horizon=3,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(one, 0.5 * one),
        perturbation=pc.DirectionalPerturbation([one], np.array([0.5])),
        initial_state=[1.0],
    )


def test_threshold_matches_enumeration_of_every_path_where_the_law_is_fixed():
    """Scalar policy: 𝓛 is the number E(1 - η𝒥)², stable iff η < 2 E𝒥 / E𝒥²; 𝒥 by hand on all 64 paths."""
    jacobians = []
    for signs in itertools.product([-1, 1], repeat=6):
        w, delta = signs[:3], np.array(signs[3:]) * 0.5
        response = 0.0
        curvature = 0.0
        for t in range(4):
            by_u = w[t - 1] if t else 0.0
            curvature += 2 * response**2 + 2 * 0.5 * by_u**2
            if t < 3:
                response = (0.8 + delta[t]) * response + by_u
        jacobians.append(curvature)
    exact = 2 * np.mean(jacobians) / np.mean(np.square(jacobians))
    stability = mean_square_stability(enumerated_problem(), samples=4096)
    assert abs(stability.threshold_estimate - exact) < 5 * stability.standard_error
    assert stability.standard_error < 0.02 * exact
    batched = mean_square_stability(enumerated_problem(), samples=4096, batch=4)
    mean, square = np.mean(jacobians), np.mean(np.square(jacobians))
    assert batched.threshold_estimate == pytest.approx(2 * mean / (square / 4 + 0.75 * mean**2), rel=0.02)
    assert batched.spectral_radius(batched.threshold_estimate) == pytest.approx(1.0, abs=0.02)


def test_threshold_by_one_eigenvalue_matches_bisection_on_the_spectral_radius():
    problem = random_problem(3, bounded=False, strength=0.2)
    stability = mean_square_stability(problem, samples=2048)
    low, high = 0.0, 3 * stability.threshold_estimate
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if stability.spectral_radius(middle, 1e-8) < 1 else (low, middle)
    assert low == pytest.approx(stability.threshold_estimate, abs=4 * stability.standard_error)
    X = stability.stationary_covariance(low / 3)
    step = low / 3
    np.testing.assert_allclose(
        X, stability.operator(step)(X) + step**2 * stability.gradient_covariance, rtol=1e-4, atol=1e-6 * np.abs(X).max()
    )


@pytest.mark.slow
def test_error_floor_matches_simulation_at_a_safe_step():
    problem = random_problem(3, bounded=False, strength=0.05)
    M = pc.solve(problem, pc.StablePoint()).M
    stability = mean_square_stability(problem, M, samples=1024)
    step = stability.threshold_estimate / 20
    solver = pc.RSGD(1500, step)
    keys = jax.random.split(jax.random.key(5), 16)

    def one(key):
        record = pc.solve(problem, solver, M, key=key, record=lambda N: jnp.sum((N - M) ** 2)).history
        return jnp.mean(record[300:])

    errors = np.asarray(jax.lax.map(one, keys))
    spread = errors.std(ddof=1) / 4
    assert errors.mean() == pytest.approx(stability.error_floor(step), abs=5 * spread + 0.1 * errors.mean())


@pytest.mark.slow
def test_products_with_probes_match_the_matrices():
    problem = random_problem(3, bounded=False, strength=0.2)
    M = pc.solve(problem, pc.StablePoint()).M
    basis = np.eye(M.size)
    held = JacobianSamples(problem, M, basis, jax.random.key(0), 2000)
    probed = JacobianSamples(problem, M, basis, jax.random.key(0), 2000, matrices=False)
    X = np.diag(np.arange(1.0, M.size + 1))
    assert held.held is not None and probed.held is None
    for one, two in ((held.mean_square(X), probed.mean_square(X)), (held.adjoint(X), probed.adjoint(X))):
        assert np.linalg.norm(one - two) < 0.15 * np.linalg.norm(one)
    assert probed.values(X, X).mean() == pytest.approx(held.values(X, X).mean(), rel=0.15)
    drift = hessian(problem, M) + reaction_jacobian(problem, M, M)
    assert held.held.mean(axis=0) == pytest.approx(drift, abs=6 * held.held.std() / np.sqrt(2000) * 3)


def test_leading_eigenvalue_matches_a_dense_kronecker_operator():
    r = np.random.default_rng(0)
    maps = r.standard_normal((3, 4, 4))
    value, _ = leading_eigenvalue(lambda X: sum(J @ X @ J.T for J in maps), 4, 1e-12, 5000)
    dense = sum(np.kron(J, J) for J in maps)
    assert value == pytest.approx(np.abs(np.linalg.eigvals(dense)).max(), rel=1e-9)


def test_safe_step_keeps_descent_stable_and_four_thresholds_do_not():
    problem = random_problem(3, bounded=False, strength=0.05)
    step = safe_step(problem)
    stability = mean_square_stability(problem)
    assert step == pytest.approx((stability.threshold_estimate - 2 * stability.standard_error) / 4)
    assert safe_step(problem, batch=8) > step
    M = pc.solve(problem, pc.StablePoint()).M
    good = pc.solve(problem, pc.RSGD(2000, step), key=jax.random.key(1))
    assert float(jnp.sum((good.M - M) ** 2)) < 20 * stability.error_floor(step)
    bad = pc.solve(problem, pc.RSGD(2000, stability.mean_threshold * 4), key=jax.random.key(1), throw=False)
    assert bad.result == pc.Result.diverged


def test_strong_performativity_makes_the_local_test_only_local():
    """Φ(M) = 3 tanh(2(M - 2)) + M/10 contracts at each outer fixed point, and stretches sixfold between them."""
    one = np.ones((1, 1))
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0 * one, -one),
        horizon=2,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost(np.array([0.0, 0.0, 0.5]).reshape(3, 1, 1), 0 * one),
        perturbation=pc.DirectionalPerturbation(
            [one], np.array([0.1]), mean=lambda M: jnp.stack([0 * M[0], -1 + 3 * jnp.tanh(2 * (M[0] - 2)) + 0.1 * M[0]])
        ),
    )
    certificate = pc.certify(problem, "sharp", samples=0, pairs=64)
    assert certificate.holds is True
    assert certificate.values["contraction_estimate"] > 1.5
    far = [pc.solve(problem, pc.RRM(), np.full((1, 1, 1), start)).M.item() for start in (-1.0, 4.0)]
    assert abs(far[0] - far[1]) > 1  # another stable policy attracts from elsewhere


def test_contraction_estimate_is_a_lower_estimate_of_the_proved_modulus():
    problem = random_problem(1, strength=0.1)
    assert contraction_estimate(problem, pairs=6) <= pc.certify(problem, "rigorous").rate


def test_safe_step_refuses_an_unstable_mean_field_and_bad_safety():
    with pytest.raises(pc.InputError, match="StablePoint"):
        safe_step(prediction_problem(1.5))
    with pytest.raises(pc.InputError, match="safety"):
        safe_step(prediction_problem(0.5), safety=2.0)
    with pytest.raises(pc.InputError, match="threshold"):
        mean_square_stability(prediction_problem(0.5), samples=64).error_floor(100.0)


STOCK_THRESHOLDS = {"ascending": 0.0240, "random": 0.0090, "descending": 0.0046}


@pytest.mark.slow
def test_stock_threshold_predicts_which_orders_diverge_at_the_papers_step():
    problem = pc.experiments.stock_market("descending", 1.0)
    stability = mean_square_stability(problem, samples=192)
    threshold, error = (60 * value for value in (stability.threshold_estimate, stability.standard_error))
    assert threshold == pytest.approx(STOCK_THRESHOLDS["descending"], abs=4 * error)
    assert threshold < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("order", STOCK_THRESHOLDS)
def test_stock_thresholds_match_the_published_figure(order):
    problem = pc.experiments.stock_market(order, 1.0)
    stability = mean_square_stability(problem, samples=2048)
    threshold, error = (60 * value for value in (stability.threshold_estimate, stability.standard_error))
    assert threshold == pytest.approx(STOCK_THRESHOLDS[order], abs=4 * error)
    assert (threshold < 0.01) is (order != "ascending")
