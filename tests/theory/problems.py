"""Random admissible problems of a few fixed shapes, so that everything compiles once."""

import numpy as np

import perfcontrol as pc

SHAPES = {"small": (2, 1, 2, 5, 2), "scalar": (1, 1, 1, 4, 1), "wide": (3, 2, 1, 6, 2)}  # n, m, H, T, directions


def random_problem(
    seed: int,
    shape: str = "small",
    *,
    strength: float | None = None,
    skew: float = 0.0,
    bounded: bool = True,
    growth: float | None = None,
    law: str = "rademacher",
    noise_mean: float = 0.0,
) -> pc.PerformativeProblem:
    """A problem with quadratic cost and directional perturbations.

    strength: size of the reaction; skew: how far from normal the closed loop is (κ > 1); growth: its spectral radius.
    """
    r = np.random.default_rng(seed)
    n, m, H, T, k = SHAPES[shape]
    A = r.standard_normal((n, n))
    if skew and n > 1:
        tilt = np.eye(n) + skew * np.triu(r.standard_normal((n, n)), 1)
        A = tilt @ A @ np.linalg.inv(tilt)
    B = r.standard_normal((n, m))
    K = 0.3 * r.standard_normal((m, n))
    radius = r.uniform(0.1, 0.9) if growth is None else growth
    A = A * radius / np.abs(np.linalg.eigvals(A)).max() + B @ K  # so that A - BK has that spectral radius
    D = r.standard_normal((k, n, n))
    D /= np.linalg.norm(D, 2, axis=(1, 2), keepdims=True)
    strength = 10 ** r.uniform(-4, 0.3) if strength is None else strength
    slope = strength * r.standard_normal((T, k, H, m, n)) * r.uniform(size=(T, k, 1, 1, 1))
    Q, R = (x @ x.T / len(x) + 0.2 * np.eye(len(x)) for x in (r.standard_normal((n, n)), r.standard_normal((m, m))))
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, B),
        horizon=T,
        memory=H,
        gain=K,
        noise=pc.Rademacher(r.uniform(0.3, 1.0, n), mean=noise_mean * r.standard_normal(n)),
        cost=pc.QuadraticCost(Q, R),
        perturbation=pc.DirectionalPerturbation(D, pc.Affine(r.uniform(0, 0.3, (T, k)), slope), law=law),
        feasible_set=pc.FrobeniusBall(float(r.uniform(0.3, 2.0))) if bounded else pc.Unconstrained(),
        initial_state=r.standard_normal(n),
    )


def prediction_problem(sensitivity: float, mean: float = 10.0, deviation: float = 0.1) -> pc.PerformativeProblem:
    """Scalar performative mean estimation as a control problem: Φ(θ) = mean + sensitivity θ."""
    one = np.ones((1, 1))
    Q = np.zeros((3, 1, 1))
    Q[2] = 0.5
    slope = np.array([0.0, sensitivity]).reshape(2, 1, 1, 1, 1, 1)
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0 * one, -one),
        horizon=2,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost(Q, 0 * one),
        perturbation=pc.DirectionalPerturbation(
            [one], np.array([[0.0], [deviation]]), mean=pc.Affine(np.array([[[0.0]], [[mean - 1]]]), slope)
        ),
    )


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


def small_reaction():
    return random_problem(0, "scalar", strength=1e-5)
