"""Known plants that react, drawn at random and simulated in plain NumPy: what identification is measured against."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import perfcontrol as pc

KINDS = ("norm", "squared norm", "affine", "matrix", "matrix and affine")
DEPLOYMENTS = 5


@dataclass(frozen=True)
class Plant:
    """x⁺ = (A + Θ(M) + Σ_k σ_k(M) ζ_k D_k) x + B u + w, Θ(M) = slope <M, axis>; everything is Gaussian.

    kind: what reacts. scale (k, 2): σ_k(M) = scale_k0 + scale_k1 f(M), f the norm, its square, or <M, axis>.
    policies (5, H, m, n): those deployed, the first of them zero. axis lies in their span.
    """

    kind: str
    A: np.ndarray
    B: np.ndarray
    K: np.ndarray
    noise: np.ndarray
    directions: np.ndarray
    scale: np.ndarray
    axis: np.ndarray
    slope: np.ndarray
    policies: np.ndarray

    @property
    def features(self) -> dict[str, str]:
        """What mean and scale follow, by the names of `pc.fit`."""
        by_scale = {"matrix": "constant", "matrix and affine": "affine"}.get(self.kind, self.kind)
        return {"mean": "affine" if self.kind.startswith("matrix") else "constant", "scale": by_scale}

    def scales(self, M: np.ndarray) -> np.ndarray:
        """σ(M), (k,)."""
        norm = np.linalg.norm(M)
        feature = {"norm": norm, "squared norm": norm**2, "matrix": 0.0, "constant": 0.0}.get(
            self.kind, np.sum(M * self.axis)
        )
        return self.scale[:, 0] + self.scale[:, 1] * feature

    def mean(self, M: np.ndarray) -> np.ndarray:
        """Θ(M), (n, n)."""
        return self.slope * (np.sum(M * self.axis) if self.kind.startswith("matrix") else 0.0)

    def growth(self, M: np.ndarray) -> float:
        """Spectral radius of X -> E F X Fᵀ in the world that M makes: below one, it is mean-square stable."""
        F = self.A - self.B @ self.K + self.mean(M)
        spread = sum(s**2 * np.kron(D, D) for s, D in zip(self.scales(M), self.directions, strict=True))
        return float(np.abs(np.linalg.eigvals(np.kron(F, F) + spread)).max())

    def frozen(self) -> "Plant":
        """The world of the first policy under any."""
        scale = np.stack([self.scales(self.policies[0]), np.zeros(len(self.scale))], axis=1)
        return replace(self, kind="constant", scale=scale)

    def logs(self, r: np.random.Generator, episodes: int, horizon: int, worlds: "list[Plant] | None" = None) -> pc.Logs:
        """So many episodes of each policy, each in its own of the worlds; None: all in this one."""
        pairs = zip(self.policies, worlds or [self] * DEPLOYMENTS, strict=True)
        x, u = zip(*(world._paths(r, M, episodes, horizon) for M, world in pairs), strict=True)
        return pc.Logs(np.concatenate(x), np.concatenate(u), np.repeat(self.policies, episodes, axis=0))

    def _paths(
        self, r: np.random.Generator, M: np.ndarray, episodes: int, horizon: int
    ) -> tuple[np.ndarray, np.ndarray]:
        n, m = self.B.shape
        w = r.standard_normal((horizon, episodes, n)) @ np.linalg.cholesky(self.noise).T
        zeta = r.standard_normal((horizon, episodes, len(self.directions)))
        A = self.A + self.mean(M) + np.tensordot(zeta * self.scales(M), self.directions, axes=1)
        x, u = np.empty((episodes, horizon + 1, n)), np.empty((episodes, horizon, m))
        x[:, 0] = r.standard_normal((episodes, n))
        for t in range(horizon):
            u[:, t] = -x[:, t] @ self.K.T
            for lag, block in enumerate(M[:t], start=1):
                u[:, t] += w[t - lag] @ block.T
            x[:, t + 1] = np.einsum("eij,ej->ei", A[t], x[:, t]) + u[:, t] @ self.B.T + w[t]
        return x, u

    def problem(self, **world: Any) -> pc.PerformativeProblem:
        """The truth as a problem; `world`: cost, horizon and feasible set."""
        n = len(self.A)
        scale: Any = pc.Norm(self.scale[:, 0], self.scale[:, 1], squared=self.kind == "squared norm")
        if self.kind not in ("norm", "squared norm"):
            scale = pc.Affine(self.scale[:, 0], self.scale[:, 1, None, None, None] * self.axis)
        mean = pc.Affine(0 * self.slope, self.slope[:, :, None, None, None] * self.axis)
        return pc.PerformativeProblem(
            system=pc.LinearSystem(self.A, self.B),
            gain=self.K,
            memory=self.policies.shape[1],
            noise=pc.Gaussian(np.zeros(n), self.noise),
            initial_state=pc.Gaussian(np.zeros(n), np.eye(n)),
            perturbation=pc.DirectionalPerturbation(
                self.directions, scale, mean if self.kind.startswith("matrix") else None
            ),
            **world,
        )


def plant(seed: int, n: int | None = None, kind: str | None = None) -> Plant:
    """n from 2 to 6 and the kinds of reaction in turn; mean-square stable under every policy that was deployed."""
    r = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)] if kind is None else kind
    n = 2 + seed // len(KINDS) % 5 if n is None else n
    m, H, k = 1 + n // 4, 1 + seed % 2, 1 + n // 4
    while True:
        A, B = r.standard_normal((n, n)), r.standard_normal((n, m))
        A *= r.uniform(0.7, 1.0) / np.abs(np.linalg.eigvals(A)).max()
        K = 0.3 * np.asarray(pc.design_gain(pc.LinearSystem(A, B), Q=np.eye(n), R=np.eye(m)))
        root = np.eye(n) + 0.3 * r.standard_normal((n, n))
        D = _units(r.standard_normal((k, n, n)))
        tried = _units(r.standard_normal((DEPLOYMENTS - 1, H, m, n)))
        tried *= r.uniform(0.3, 0.8, (len(tried), 1, 1, 1))
        axis = _units(np.tensordot(r.standard_normal(len(tried)), tried, axes=1)[None])[0]
        slope = 0.8 * _units(r.standard_normal((1, n, n)))[0]
        grows = {"matrix": 0.0, "affine": 0.7, "matrix and affine": 0.7}.get(kind, 1.0)
        scale = np.stack([r.uniform(0.2, 0.4, k), grows * r.uniform(0.5, 1.0, k)], axis=1)
        policies = np.concatenate([np.zeros((1, H, m, n)), tried])
        made = Plant(kind, A, B, K, 0.1 * root @ root.T, D, scale, axis, slope, policies)
        if all(made.growth(M) < 0.95 for M in policies):
            return made


def _units(stack: np.ndarray) -> np.ndarray:
    """Every entry of the stack with Frobenius norm one."""
    sizes = np.sqrt(np.sum(stack**2, axis=tuple(range(1, stack.ndim)), keepdims=True))
    return stack / sizes
