"""Counterexamples to what the paper prints, one for each erratum that a number can show (docs: errata)."""

import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory.certificates.constants import growth, printed_constants, repaired_constants, rigorous_constants
from perfcontrol.theory.certificates.ingredients import gather
from perfcontrol.theory.derivatives import hessian
from perfcontrol.theory.rates.propositions import envelope_shape
from perfcontrol.theory.stability.strong_stability import candidates


def scalar_problem(A=0.9, b=1.0, K=0.0, weight=0.5, horizon=200, x0=0.0, noise=None, radius=1.0):
    one = np.ones((1, 1))
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A * one, b * one),
        horizon=horizon,
        noise=pc.Constant([1.0]) if noise is None else noise,
        cost=pc.QuadraticCost(weight * one, weight * one),
        gain=K * one,
        feasible_set=pc.FrobeniusBall(radius),
        initial_state=[x0],
    )


def curvature(horizon, A=0.9, b=1.0, weight=0.5):
    """∂²c_T/∂M² for w ≡ 1 and K = 0: 2 weight ((b Σ_{i<T-1} Aⁱ)² + 1)."""
    return 2 * weight * ((b * (1 - A ** (horizon - 1)) / (1 - A)) ** 2 + 1)


def test_a_window_of_one_block_more_breaks_the_bound_of_its_norm():
    """Erratum 1: [w] with H+1 blocks of norm W has norm √(H+1) W, above H W for H = 1."""
    assert np.linalg.norm(np.ones(2)) > 1.0
    assert np.linalg.norm(np.ones(1)) <= 1.0


def test_main_text_smoothness_fails_under_scaling():
    """Erratum 2: c₁(c₄β+c₅) scales with ς², the curvature with ς."""
    varsigma, kappa, gamma, beta = 0.01, 1.0, 0.1, growth(np.full(200, 0.9))[1][-1]
    c1 = varsigma * (1 + (kappa**2 + kappa**3)) * (kappa**2 + kappa**3) / (1 - gamma)
    c4, c5 = (1 - gamma) * c1, (1 - gamma) * c1 / (kappa**2 + kappa**3)
    printed = c1 * (c4 * beta + c5)
    assert printed == pytest.approx(0.042, rel=0.01)
    assert curvature(201, weight=0.005) == pytest.approx(1.01, rel=1e-3) and curvature(201, weight=0.005) > printed


def test_appendix_smoothness_loses_a_factor_beta():
    """Erratum 3: true curvature 101, printed 63."""
    items = gather(scalar_problem())
    printed = printed_constants(items, 1.0, 0.1).smoothness[-1]
    assert printed == pytest.approx(63, rel=1e-3)
    assert curvature(200) == pytest.approx(101, rel=1e-3)
    assert curvature(200) > printed
    assert repaired_constants(items, 1.0, 0.1).smoothness[-1] >= curvature(200)
    bound = rigorous_constants(
        items, next(candidates(scalar_problem().system, np.zeros((1, 1)), items.perturbation_bound))
    )
    assert bound.smoothness[-1] >= curvature(200)


def test_appendix_smoothness_loses_a_factor_of_the_input_matrix_even_in_expectation():
    """Erratum 3: b = 100, w = ±1: E ∂²c_T/∂M² = b²/(1-0.81) + 1 = 52632, printed 4221."""
    problem = scalar_problem(b=100.0, noise=pc.Rademacher(1.0), horizon=100)
    printed = printed_constants(gather(problem), 1.0, 0.1).smoothness[-1]
    exact = 100.0**2 * sum(0.81**i for i in range(99)) + 1
    assert printed == pytest.approx(4221, rel=1e-3) and exact == pytest.approx(52633, rel=1e-4)
    assert exact > printed


def test_printed_propagation_is_exceeded():
    """Erratum 3: Ã = 0.9, K = 1, b = 100, x₀ = 1e9, κ = 1: ∂(∇_M c_t)/∂Δ_k above the printed ν_t."""
    b, A, K, T, x0 = 100.0, 100.9, 1.0, 40, 1e9
    items = gather(scalar_problem(A=A, b=b, K=K, horizon=T, x0=x0))
    printed = printed_constants(items, 1.0, 0.1).propagation
    rigorous = rigorous_constants(
        items, next(candidates(pc.LinearSystem([[A]], [[b]]), np.array([[K]]), items.perturbation_bound))
    ).propagation
    M, w = 1.0, np.ones(T)

    def stage_gradients(delta):
        x, dx, out = x0, 0.0, []
        for t in range(T + 1):
            v, dv = (M * w[t - 1], w[t - 1]) if t else (0.0, 0.0)
            u, du = -K * x + v, -K * dx + dv
            out.append(x * dx + u * du)
            if t < T:
                x, dx = (A + delta[t]) * x + b * u + w[t], (A + delta[t]) * dx + b * du
        return np.array(out)

    worst = 0.0
    for k in range(1, T):
        step = np.zeros(T)
        step[k] = 1e-6
        slope = np.abs(stage_gradients(step) - stage_gradients(-step)) / 2e-6
        later = np.arange(T + 1) > k
        worst = max(worst, np.max(slope[later] / printed[later, k]))
        assert np.all(slope[later] <= rigorous[later, k] * (1 + 1e-5))
    assert worst > 1.5


def test_product_differences_lose_an_outer_kappa_squared():
    """Erratum 4: Ã = 0.9 [[0, κ²], [κ⁻², 0]]: ‖Π(Ã+Δ) - Π(Ã+Δ')‖ is κ⁴ 0.81 d, printed κ² 0.81 d."""
    kappa, d = 3.0, 1e-6
    A = 0.9 * np.array([[0, kappa**2], [kappa**-2, 0]])
    change = d * np.array([[0.0, 0.0], [1.0, 0.0]])
    difference = np.linalg.norm(A @ (A + change) @ A - A @ A @ A, 2)
    printed = (0.9 + kappa**2 * d) ** 3 * kappa**2 / 0.9 * d
    assert difference == pytest.approx(0.81 * kappa**4 * d)
    assert difference > 2 * printed
    assert difference <= kappa**2 * printed * (1 + 1e-3)


def test_the_order_of_the_product_matters():
    """The state's product Π_{j=i+1}^{t-1} must have the largest index on the left."""
    r = np.random.default_rng(0)
    steps, x0 = r.standard_normal((3, 2, 2)), r.standard_normal(2)
    x = x0
    for step in steps:
        x = step @ x
    np.testing.assert_allclose(steps[2] @ steps[1] @ steps[0] @ x0, x)
    assert np.linalg.norm(steps[0] @ steps[1] @ steps[2] @ x0 - x) > 0.1


def test_gradient_bound_needs_the_bound_of_the_input_too():
    """Erratum 5: c = (x+u)²/2, B = 0, M = 10: ‖∇_x c_1‖ = 11 W, above the printed G κ² W(‖B‖HM+1)β_1 = 2W."""
    x, u, G, W = 1.0, 10.0, 2.0, 1.0
    assert abs(x + u) > G * W
    assert abs(x + u) <= G * max(abs(x), abs(u))


def test_printed_exponential_is_below_the_proved_product():
    """Erratum 8: e^{-Σ φ₁m/n} < Π(1 - φ₁m/(n+φ₂)) for φ₂ > 1."""
    phi1, phi2, m = 10.0, 801.0, 0.1
    n = np.arange(100)
    assert np.exp(-m * phi1 * np.sum(1 / (n + 1))) < 0.02 < np.prod(1 - m * phi1 / (n + phi2))
    # and performative prediction at ε = 0.9 attains the square of that product: the printed term is exceeded
    assert np.prod(1 - m * phi1 / (n + phi2)) ** 2 > np.exp(-m * phi1 * np.sum(1 / (n + 1)))


def test_appendix_step_limit_allows_a_negative_factor():
    """Erratum 8: at η = 1.5/m, below the appendix's 2/m, 1 - ηm is negative and the product is no bound."""
    assert 1 - 1.5 < 0


def test_envelope_of_the_unstable_case_drops_a_growing_factor():
    """Erratum 9: the true envelope spans a factor 11 over sixty steps, the printed one 3035."""
    true, printed = envelope_shape(1.1, 60), envelope_shape(1.1, 60, printed=True)
    assert true.max() / true.min() == pytest.approx(10.96, abs=0.01)
    assert printed.max() / printed.min() == pytest.approx(3034.8, abs=0.1)
    sums = np.array([sum(1.1**i for i in range(t + 1, 61)) for t in range(60)])
    np.testing.assert_allclose(true, 1 / (0.1 * sums), rtol=1e-9)  # Σ ζⁱ = (ζ^{T+1} - ζ^{t+1})/(ζ - 1)


def test_a_norm_above_one_is_not_instability():
    """Erratum 9: ‖Ã‖ = 8.1 > 1 for a spectral radius 0.9, so ‖A_t‖ ≤ 1 - γ + κ²ξ_t fails for κ > 1."""
    kappa = 3.0
    A = 0.9 * np.array([[0, kappa**2], [kappa**-2, 0]])
    assert np.linalg.norm(A, 2) > 8 and np.abs(np.linalg.eigvals(A)).max() == pytest.approx(0.9)


def test_leaving_out_the_terminal_stage_changes_the_gradient():
    """Erratum 10: the sum over t = 0..T-1 is another gradient than that of the printed objective."""
    one = np.ones((1, 1))
    problem = scalar_problem(horizon=3, noise=pc.Rademacher(1.0))
    cut = pc.PerformativeProblem(
        system=problem.system,
        horizon=3,
        noise=problem.noise,
        cost=pc.QuadraticCost(
            np.array([0.5, 0.5, 0.5, 0.0]).reshape(4, 1, 1), np.array([0.5, 0.5, 0.5, 0.0]).reshape(4, 1, 1)
        ),
    )
    full, without = (pc.expected_gradient(p, 0.3 * one[None]) for p in (problem, cut))
    assert abs(float((full - without).squeeze())) > 0.1


def test_existence_does_not_need_small_sensitivities():
    """Erratum 12: on a compact set a stable policy exists where the condition fails by far."""
    one = np.ones((1, 1))
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * one, one),
        horizon=4,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(one, one),
        perturbation=pc.DirectionalPerturbation([one], pc.Affine([0.1], 50 * np.ones((1, 1, 1, 1)))),
        feasible_set=pc.FrobeniusBall(1.0),
    )
    certificate = pc.certify(problem, "rigorous")
    assert certificate.holds is False and certificate.exists is True
    M = np.linspace(-1, 1, 41)
    gap = [float(pc.best_response(problem, np.full((1, 1, 1), m)).squeeze()) - m for m in M]
    assert gap[0] > 0 > gap[-1]  # so the continuous Φ has a fixed point between


def test_the_jensen_bound_fails_where_the_mean_depends_on_the_policy():
    """Erratum 13: with Θ(M') = 0.5 M' a deployed policy can flatten the cost below its value at Δ = 0."""
    one = np.ones((1, 1))
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * one, one),
        horizon=4,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost(one, one),
        perturbation=pc.DirectionalPerturbation(
            [one], np.array([0.0]), mean=pc.Affine(0 * one, 0.5 * np.ones((1, 1, 1, 1, 1)))
        ),
    )
    at_zero, at_minus_one = (hessian(problem, jnp.full((1, 1, 1), m)).item() for m in (0.0, -1.0))
    assert at_minus_one < at_zero


def test_as_printed_the_stock_volatility_is_degenerate():
    """Erratum 15: log ε_t ≤ -1.996, so clip(N(log ε_t, 0.2²), -0.6, 0.6) is -0.6 on almost every day."""
    epsilon = pc.experiments.stock.stock_sensitivities("ascending")
    assert np.log(epsilon.max()) < -1.99 and epsilon.sum() == pytest.approx(2.0)
    assert (-0.6 - np.log(epsilon.max())) / 0.2 > 6.9
