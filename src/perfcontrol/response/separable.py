"""Best response without constraint, structure or change in the noise: the Hessian is 2 (G ⊗ Σ + G̃ ⊗ w̄w̄ᵀ).

With u = Σ⁻¹w̄ and s = w̄ᵀu, M̂ = Y + y uᵀ/s where Y w̄ = 0: Y, what does not meet the mean, needs G alone, and y = M̂ w̄
needs G + s G̃: two solves with H m unknowns. Where G or Σ is singular, the dense method serves.
"""

from collections.abc import Callable
from typing import Any

from perfcontrol._programs import cond, numerics
from perfcontrol.response.definite import Definite
from perfcontrol.response.quadratic import Factors, Operator


class Separable:
    """The quadratic given by its factors.

    Args:
        factors: of the quadratic. dense: the method that serves where G or Σ is singular.
    """

    def __init__(self, factors: Factors, dense: Callable[[], Any]):
        self.factors = self.form = factors
        self.dense = dense
        xp, self.linalg = numerics(factors)
        linear, G, G_mean, Sigma, w = factors
        self.shape = linear.shape
        self.G, self.Sigma = Definite(G), Definite(Sigma)
        self.regular = self.G.regular & self.Sigma.regular
        largest = self.G.largest * self.Sigma.largest
        if w is not None:
            largest = largest + xp.linalg.norm(G_mean) * (w @ w)
            u = self.Sigma.solve(w[:, None])[:, 0]
            squared = w @ u
            self.unit = u / xp.where(squared > 0, squared, 1)
            shift = xp.where(self.regular, 0, 1).astype(G.dtype) * xp.eye(len(G), dtype=G.dtype)
            self.along = G + squared * G_mean + shift
        self.step = 1 / xp.maximum(2 * largest, xp.finfo(G.dtype).tiny)

    def _separately(self, gradients: Any) -> Any:
        """Newton steps for gradients (k, H, m, n)."""
        right = gradients.reshape(-1, len(self.factors.G), self.shape[-1]) / -2
        right = self.Sigma.solve(right.swapaxes(-1, -2)).swapaxes(-1, -2)
        if self.factors.w is None:
            return self.G.solve(right).reshape(gradients.shape)
        mean_part = right @ self.factors.w  # (k, Hm)
        across = self.G.solve(right - mean_part[..., None] * self.unit)
        factor = self.linalg.cho_factor(self.along, lower=True)
        along = self.linalg.cho_solve(factor, mean_part.T).T
        return (across + along[..., None] * self.unit).reshape(gradients.shape)

    def solve(self, gradient: Any) -> Any:
        """The Newton step for a gradient, or for each of several along the first axis."""
        several = gradient.reshape(-1, *self.shape)
        steps = cond(self.regular, lambda: self._separately(several), lambda: self.dense().solve(several))
        return steps.reshape(gradient.shape)

    def minimise(self, start: Any) -> tuple[Any, Any]:
        """The minimiser (of least norm), and whether it is the only one."""
        return cond(self.regular, lambda: (self.only(), self.regular), lambda: self.dense().minimise(start))

    def only(self) -> Any:
        """The minimiser where the factors are regular."""
        M = self._separately(self.factors.linear[None])[0]
        return M + self._separately(self.factors.gradient(M)[None])[0]  # one step of iterative refinement

    def newton(self, M: Any) -> Operator:
        """gradient -> the Newton step from near the minimiser M."""
        return self.solve

    def jacobian(self, M: Any, reaction: Any) -> Any:
        """Φ', (p, p), given 𝐄 = ∂_2 g, (p, p)."""
        return self.solve(reaction.T).T
