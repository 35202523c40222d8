"""How RSGD gets a gradient ∇_1 C_T(M; deployed)."""

import equinox as eqx
from jaxtyping import Array, Key

from perfcontrol.evaluate.adjoint import mean_path_gradient
from perfcontrol.evaluate.exact import exact_gradient
from perfcontrol.evaluate.loop import require_moments
from perfcontrol.problem import PerformativeProblem


class Pathwise(eqx.Module):
    """From `batch` simulated paths, noise and perturbations observed: the paper's estimator (Appendix B)."""

    def check(self, problem: PerformativeProblem) -> None:
        """Every problem can be simulated."""

    def __call__(
        self, problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""], batch: int
    ) -> Array:
        return mean_path_gradient(problem, M, deployed, key, batch)


class Exact(eqx.Module):
    """The expectation itself: repeated gradient descent, the mean field of RSGD. The key is not used."""

    def check(self, problem: PerformativeProblem) -> None:
        """Needs known moments and a quadratic cost."""
        require_moments(problem)

    def __call__(
        self, problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""] | None, batch: int
    ) -> Array:
        return exact_gradient(problem, M, deployed)
