"""How RSGD gets a gradient ∇_1 C_T(M; deployed): the interface, the paper's estimator, the expectation."""

import abc

import equinox as eqx
from jaxtyping import Array, Key

from perfcontrol.evaluate.adjoint import mean_path_gradient
from perfcontrol.evaluate.exact import exact_gradient
from perfcontrol.evaluate.loop import require_moments
from perfcontrol.problem import PerformativeProblem


class AbstractGradient(eqx.Module):
    """A way to a gradient; samples unless it says otherwise, and then applies to every problem."""

    @property
    def needs_key(self) -> bool:
        """Whether it draws random numbers."""
        return True

    @property
    def lanes(self) -> int | None:
        """How many runs a device works on together (`AbstractSolver.lanes`)."""
        return None

    def check(self, problem: PerformativeProblem) -> None:
        """Raise InputError where it does not apply: every problem can be simulated."""

    @abc.abstractmethod
    def __call__(
        self, problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""], batch: int
    ) -> Array:
        """The gradient in the free parameters, from `batch` paths of the world that reacts to `deployed`."""


class Pathwise(AbstractGradient):
    """From `batch` simulated paths, noise and perturbations observed: the paper's estimator (Appendix B)."""

    def __call__(
        self, problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""], batch: int
    ) -> Array:
        return mean_path_gradient(problem, M, deployed, key, batch)


class Exact(AbstractGradient):
    """The expectation itself: repeated gradient descent, the mean field of RSGD. The key is not used."""

    @property
    def needs_key(self) -> bool:
        return False

    def check(self, problem: PerformativeProblem) -> None:
        """Needs known moments and a quadratic cost."""
        require_moments(problem)

    def __call__(
        self, problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""] | None, batch: int
    ) -> Array:
        return exact_gradient(problem, M, deployed)
