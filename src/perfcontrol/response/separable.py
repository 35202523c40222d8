"""Best response without constraint, structure or change in the noise: the Hessian is 2 (G ⊗ Σ + G̃ ⊗ w̄w̄ᵀ).

With a = Σ^{-1/2} w̄ and Y = M̂ Σ^{1/2}: the part of Y across a meets G alone, the part along a G + |a|² G̃: two solves
with H m unknowns. Where G or Σ is singular, the dense method serves.
"""

from collections.abc import Callable
from typing import Any

from perfcontrol._programs import cond, known, numerics
from perfcontrol.response.definite import Definite
from perfcontrol.response.quadratic import Factors, Operator


class Separable:
    """The quadratic given by its factors.

    Args:
        factors: of the quadratic. dense: the method that serves where G or Σ is singular.
    """

    def __init__(self, factors: Factors, dense: Callable[[], Any]):
        self.factors, self.dense = factors, dense
        xp, self.linalg = numerics(factors)
        _, G, G_mean, Sigma, w = factors
        self.shape = H, m, n = factors.linear.shape
        eps, tiny = xp.finfo(G.dtype).eps, xp.finfo(G.dtype).tiny
        self.G = Definite(G)
        S_values, S_vectors = xp.linalg.eigh(Sigma)
        self.regular = self.G.regular & (S_values[0] > n * eps * S_values[-1])
        largest = 2 * (self.G.largest * S_values[-1] + xp.linalg.norm(G_mean) * (w @ w))
        self.step = 1 / xp.maximum(largest, tiny)
        self.inverse_root = (S_vectors / xp.sqrt(xp.where(S_values > 0, S_values, 1))) @ S_vectors.T
        self.centred = known(w) and not xp.any(w)
        a = self.inverse_root @ w
        squared = a @ a
        self.unit = a / xp.sqrt(xp.where(squared > 0, squared, 1))
        if not self.centred:
            shift = xp.where(self.regular, 0, 1).astype(G.dtype) * xp.eye(H * m, dtype=G.dtype)
            self.along = G + squared * G_mean + shift

    def _separately(self, gradients: Any) -> Any:
        """Newton steps for gradients (k, H, m, n)."""
        H, m, n = self.shape
        right = -gradients.reshape(-1, H * m, n) @ self.inverse_root / 2
        if self.centred:
            return (self.G.solve(right) @ self.inverse_root).reshape(gradients.shape)
        mean_part = right @ self.unit  # (k, Hm)
        across = right - mean_part[..., None] * self.unit
        Y = self.G.solve(across)
        factor = self.linalg.cho_factor(self.along, lower=True)
        along = self.linalg.cho_solve(factor, mean_part.T).T
        Y = Y + (along - Y @ self.unit)[..., None] * self.unit
        return (Y @ self.inverse_root).reshape(gradients.shape)

    def solve(self, gradient: Any) -> Any:
        """The Newton step for a gradient, or for each of several along the first axis."""
        several = gradient.reshape(-1, *self.shape)
        steps = cond(self.regular, lambda: self._separately(several), lambda: self.dense().solve(several))
        return steps.reshape(gradient.shape)

    def minimise(self, start: Any) -> tuple[Any, Any]:
        """The minimiser (of least norm), and whether it is the only one."""

        def regular() -> tuple[Any, Any]:
            M = self._separately(self.factors.linear[None])[0]
            M = M + self._separately(self.factors.gradient(M)[None])[0]  # one step of iterative refinement
            return M, self.regular

        return cond(self.regular, regular, lambda: self.dense().minimise(start))

    def newton(self, M: Any) -> Operator:
        """gradient -> the Newton step from near the minimiser M."""
        return self.solve

    def jacobian(self, M: Any, reaction: Any) -> Any:
        """Φ', (p, p), given 𝐄 = ∂_2 g, (p, p)."""
        return self.solve(reaction.T).T
