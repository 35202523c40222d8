"""Known worlds and their logs, simulated in plain NumPy: nothing here is shared with the package."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class World:
    """x⁺ = (A + Θ(M) + Σ_k σ_k(M) ζ_k D_k) x + B u + w, u = -K x + Σ_i M[i-1] w_{t-i}, w and ζ Gaussian unless said."""

    A: np.ndarray
    B: np.ndarray
    K: np.ndarray
    noise: np.ndarray  # covariance
    directions: np.ndarray  # (k, n, n)
    scale: object  # M -> (k,)
    mean: object = None  # M -> (n, n)
    noise_mean: object = 0.0
    signs: bool = False  # ζ = ±1
    start: float = 1.0  # standard deviation of x_0

    def episode(self, r: np.random.Generator, M: np.ndarray, horizon: int) -> tuple[np.ndarray, np.ndarray]:
        """x (T+1, n) and u (T, m)."""
        n, m = self.B.shape
        root = np.linalg.cholesky(self.noise + 1e-300 * np.eye(n))
        w = r.standard_normal((horizon, n)) @ root.T + self.noise_mean
        k = len(self.directions)
        zeta = r.choice([-1.0, 1.0], (horizon, k)) if self.signs else r.standard_normal((horizon, k))
        sigma = np.asarray(self.scale(M)) if k else np.zeros(0)
        mean = self.A + (0 if self.mean is None else self.mean(M))
        x, u = np.empty((horizon + 1, n)), np.empty((horizon, m))
        x[0] = self.start * r.standard_normal(n)
        for t in range(horizon):
            u[t] = -self.K @ x[t] + sum((M[i] @ w[t - 1 - i] for i in range(len(M)) if t > i), np.zeros(m))
            A = mean + np.tensordot(sigma * zeta[t], self.directions, axes=1)
            x[t + 1] = A @ x[t] + self.B @ u[t] + w[t]
        return x, u

    def logs(self, seed: int, policies: list, episodes: int, horizon: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x (E, T+1, n), u (E, T, m) and deployed (E, H, m, n)."""
        r = np.random.default_rng(seed)
        paths = [self.episode(r, M, horizon) for M in policies for _ in range(episodes)]
        deployed = np.repeat(np.stack(policies), episodes, axis=0)
        return np.stack([x for x, _ in paths]), np.stack([u for _, u in paths]), deployed

    def but(self, **changes: object) -> "World":
        """The same world with some things changed."""
        return replace(self, **changes)  # type: ignore[arg-type]


def small_world() -> World:
    """Two states, one input, one direction whose scale grows with the norm of the policy."""
    return World(
        A=np.array([[0.7, 0.2], [-0.1, 0.6]]),
        B=np.array([[1.0], [0.5]]),
        K=np.array([[0.2, 0.1]]),
        noise=np.array([[0.3, 0.1], [0.1, 0.2]]),
        directions=np.array([[[0.6, 0.0], [0.3, 0.7]]]),
        scale=lambda M: np.array([0.2 + 0.4 * np.linalg.norm(M)]),
    )


def small_policies() -> list[np.ndarray]:
    """Five policies (1, 1, 2), the first of them zero."""
    return [np.array([[[a, b]]]) for a, b in ((0.0, 0.0), (0.5, 0.0), (0.0, -0.6), (0.4, 0.5), (-0.8, 0.2))]
