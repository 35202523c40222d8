"""Every pathwise inequality of the rigorous version, on adversarial paths of random problems, in plain NumPy."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import perfcontrol as pc
from perfcontrol.theory.certificates.constants import products, rigorous_constants
from perfcontrol.theory.certificates.ingredients import gather
from perfcontrol.theory.stability.strong_stability import candidates
from tests.oracles.enumeration import Paths, simulate
from tests.theory.problems import SHAPES, random_problem

SLACK = 1 + 1e-9


def log_cosh(z):
    return z / 2 + np.tanh(z)  # gradient of |z|²/4 + Σ log cosh z


def stage_gradients(problem, cost, x, u):
    """∇_x c and ∇_u c on every path, (p, T+1, n) and (p, T+1, m)."""
    n = problem.state_size
    if cost == "quadratic":
        form = problem.cost.form(problem.horizon)
        z = np.concatenate([x, u], axis=-1)
        g = 2 * (np.einsum("tij,ptj->pti", np.asarray(form.matrix), z) + np.asarray(form.linear))
    else:
        g = log_cosh(np.concatenate([x, u], axis=-1))
    return g[..., :n], g[..., n:]


def ingredients(problem, cost):
    items = gather(problem)
    if cost == "log cosh":  # μ = 1/2, ς = 3/2, ‖∇_x c‖ ≤ 3/2 ‖x‖
        ones = np.ones(problem.horizon + 1)
        items = dataclasses.replace(
            items, strong_convexity=ones / 2, smoothness=1.5 * ones, gradient_bound=1.5 * ones, gradient_offset=0 * ones
        )
    return items


def paths_of(problem, items, rng, count, M):
    """Paths at the edges of what is allowed: noise, x_0 and Δ of the largest norm, half of them aligned greedily."""
    n, T = problem.state_size, problem.horizon
    A, B = np.asarray(problem.system.A), np.asarray(problem.system.B)
    K = np.asarray(problem.gain)
    x0, w, delta = np.zeros((count, n)), np.zeros((count, T, n)), np.zeros((count, T, n, n))

    def unit(v):
        norm = np.linalg.norm(v)
        return v / norm if norm > 1e-12 else np.eye(len(v))[0]

    for p in range(count):
        x0[p] = items.initial_bound * unit(rng.standard_normal(n))
        x, past = x0[p], np.zeros((problem.memory, n))
        for t in range(T):
            v = np.einsum("imn,in->m", M, past)
            drift = (A - B @ K) @ x + B @ v
            if p % 2:  # push the state outward as far as each part can
                delta[p, t] = items.perturbation_bound[t] * np.outer(unit(drift), unit(x))
                w[p, t] = items.noise_bound * unit(drift + delta[p, t] @ x)
            else:
                left, right = unit(rng.standard_normal(n)), unit(rng.standard_normal(n))
                delta[p, t] = items.perturbation_bound[t] * np.outer(left, right)
                w[p, t] = items.noise_bound * unit(rng.standard_normal(n))
            x = drift + delta[p, t] @ x + w[p, t]
            past = np.concatenate([w[p, t][None], past[:-1]])
    return Paths(np.full(count, 1 / count), x0, w, delta)


def run(problem, M, paths):
    T = problem.horizon
    A, B = (np.broadcast_to(np.asarray(a), (T, *a.shape)) for a in (problem.system.A, problem.system.B))
    return simulate(A, B, np.asarray(problem.gains()), M, paths)


def stage_policy_gradients(problem, cost, M, paths):
    """∇_M c_t on every path, (p, T+1, policy size)."""
    x, u, dx, du = run(problem, M, paths)
    by_x, by_u = stage_gradients(problem, cost, x, u)
    total = np.einsum("pta,ptaibc->ptibc", by_x, dx) + np.einsum("pta,ptaibc->ptibc", by_u, du)
    return total.reshape(*total.shape[:2], -1), x, u


def extreme_policy(problem, rng, radius):
    M = rng.standard_normal(problem.lifted_shape)
    return radius * M / np.linalg.norm(M)


@pytest.mark.parametrize("cost", ["quadratic", "log cosh"])
@settings(max_examples=6, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    shape=st.sampled_from(list(SHAPES)),
    skew=st.sampled_from([0.0, 1.0, 4.0]),
    growth=st.sampled_from([0.3, 0.9, 1.2]),
)
def test_pathwise_bounds_are_never_exceeded(cost, seed, shape, skew, growth):
    problem = random_problem(seed, shape, skew=skew, growth=growth, noise_mean=0.3 * (seed % 2))
    rng = np.random.default_rng(seed)
    items = ingredients(problem, cost)
    first = extreme_policy(problem, rng, items.policy_bound)
    second = first + rng.standard_normal() * 0.1 * extreme_policy(problem, rng, 1.0)
    second *= min(1, items.policy_bound / np.linalg.norm(second))
    paths = paths_of(problem, items, rng, 4, first)
    gradients, x, u = stage_policy_gradients(problem, cost, first, paths)
    others, _, _ = stage_policy_gradients(problem, cost, second, paths)
    k = int(rng.integers(0, problem.horizon))
    swapped = paths.perturbation.copy()
    direction = rng.standard_normal(swapped[:, k].shape)
    swapped[:, k] *= -1 if seed % 3 else 0.9
    if seed % 2:
        size = np.linalg.norm(direction, 2, axis=(1, 2), keepdims=True)
        swapped[:, k] = items.perturbation_bound[k] * direction / size
    moved, _, _ = stage_policy_gradients(problem, cost, first, paths._replace(perturbation=swapped))
    distance = np.linalg.norm(swapped[:, k] - paths.perturbation[:, k], 2, axis=(1, 2))
    stabilities = list(candidates(problem.system, np.asarray(problem.gain), items.perturbation_bound))
    assert stabilities
    for stability in stabilities[:: max(1, len(stabilities) // 4)]:
        bound = rigorous_constants(items, stability)
        assert np.all(np.linalg.norm(x, axis=-1) <= SLACK * bound.state_bound)
        assert np.all(np.linalg.norm(u, axis=-1) <= SLACK * bound.input_bound + 1e-12)
        assert np.all(np.linalg.norm(gradients, axis=-1) <= SLACK * bound.gradient + 1e-12)
        apart = np.linalg.norm(first - second)
        assert np.all(np.linalg.norm(gradients - others, axis=-1) <= SLACK * bound.smoothness * apart + 1e-9)
        change = np.linalg.norm(gradients - moved, axis=-1)
        assert np.all(
            change <= SLACK * bound.propagation[:, k] * distance[:, None] + 1e-9 * (1 + np.abs(gradients).max())
        )


def test_bounds_are_attained_by_a_scalar_problem_without_slack():
    """n = m = H = 1, K = 0, Δ = 0, constant noise: every inequality of the state and of λ_t is an equality."""
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.9]], [[1.0]]),
        horizon=6,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost([[0.5]], [[0.5]]),
        feasible_set=pc.FrobeniusBall(2.0),
        initial_state=[3.0],
    )
    items = gather(problem)
    bound = rigorous_constants(items, next(candidates(problem.system, np.asarray(problem.gain), np.zeros(6))))
    x = [3.0]
    for t in range(6):
        x.append(0.9 * x[-1] + 1.0 + (2.0 if t else 0.0))
    beta = (1 - 0.9 ** np.arange(7)) / 0.1
    np.testing.assert_allclose(bound.beta, beta)
    # w_{-1} = 0: the bound counts a feedforward at t = 0 that the policy does not have
    np.testing.assert_allclose(bound.state_bound, np.array(x) + 2 * 0.9 ** (np.arange(7) - 1.0) * (np.arange(7) > 0))
    np.testing.assert_allclose(bound.smoothness, beta**2 + 1)


def test_products_match_their_definition():
    factors = np.array([0.5, 2.0, 3.0, 0.1])
    table = products(factors)
    for t in range(5):
        for k in range(4):
            assert table[t, k] == pytest.approx(np.prod(factors[k + 1 : t]) if k < t else 0.0)


def test_growth_bound_carries_the_condition_of_the_transform():
    """Ã = 0.9 [[0, κ²], [κ⁻², 0]] with Δ = 0.1 e₂e₁ᵀ: powers grow at √(0.81 + 0.09κ²), far above 0.9 + 0.1."""
    kappa, T = 3.0, 40
    A, D = 0.9 * np.array([[0, kappa**2], [kappa**-2, 0]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(A, np.eye(2)),
        horizon=T,
        noise=pc.Constant([0.0, 0.0]),
        cost=pc.QuadraticCost(np.eye(2), np.eye(2)),
        perturbation=pc.DirectionalPerturbation([D], np.array([0.1])),
        feasible_set=pc.FrobeniusBall(1.0),
        initial_state=[1.0, 0.0],
    )
    items = gather(problem)
    x = [np.array([1.0, 0.0])]
    for _ in range(T):
        x.append((A + 0.1 * D) @ x[-1])
    for stability in candidates(problem.system, np.zeros((2, 2)), items.perturbation_bound):
        assert np.all(np.linalg.norm(x, axis=1) <= SLACK * rigorous_constants(items, stability).state_bound)


def test_smoothness_in_the_policy_is_attained_where_the_gain_dominates():
    """Scalar, A - BK = 0.9, K = 5: noise that turns its sign at the end reaches λ_T up to the missing w_{-1}."""
    T = 60
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[5.9]], [[1.0]]),
        horizon=T,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost([[0.5]], [[0.5]]),
        gain=[[5.0]],
        feasible_set=pc.FrobeniusBall(1.0),
    )
    items = gather(problem)
    bound = rigorous_constants(items, next(candidates(problem.system, np.array([[5.0]]), items.perturbation_bound)))
    w = np.ones(T)
    w[-1] = -1.0
    dx = sum(0.9 ** (T - 1 - i) * w[i - 1] for i in range(1, T))
    du = -5.0 * dx + w[-1]
    assert 0.98 * bound.smoothness[-1] <= dx**2 + du**2 <= SLACK * bound.smoothness[-1]


def test_propagation_through_the_products_is_counted():
    """Scalar, x_k = 0: Δ_k moves the gradient through the product Φ_{t,i} and the curvature alone."""
    T, k = 12, 6
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.9]], [[1.0]]),
        horizon=T,
        noise=pc.Rademacher(1.0),
        cost=pc.QuadraticCost([[0.5]], [[0.5]], state_target=[1000.0]),
        feasible_set=pc.FrobeniusBall(1.0),
    )
    items = gather(problem)
    bound = rigorous_constants(items, next(candidates(problem.system, np.zeros((1, 1)), items.perturbation_bound)))

    def last_gradient(delta):
        x = dx = 0.0
        for t in range(T):
            factor = 0.9 + (delta if t == k else 0.0)
            x, dx = factor * x + (1.0 if t else 0.0) + 1.0, factor * dx + (1.0 if t else 0.0)
        return (x - 1000.0) * dx

    slope = abs(last_gradient(1e-6) - last_gradient(-1e-6)) / 2e-6
    assert 0.5 * bound.propagation[T, k] <= slope <= SLACK * bound.propagation[T, k]
