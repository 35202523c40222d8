"""The interface of a perturbation law D_t(M), and the two kinds of operators that it hands out.

Operators keep what varies in time (`steps`, a pytree with leading axis T) apart from what does not, so that a
time loop carries only the former: loops call `*_step(step, ...)`, bulk code the methods without suffix.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from perfcontrol._linalg import Matrix, matvec, rmatvec, times, times_transposed, transpose


class PathDraws(eqx.Module):
    """One draw of Δ_0, ..., Δ_{T-1} for one path: each is applied once ahead, then at most once, transposed, back."""

    side_by_side: ClassVar[bool] = False  # whether all that products work with may have a last axis, of paths

    @property
    @abc.abstractmethod
    def steps(self) -> Any:
        """What varies in time on the way ahead, a pytree with leading axis T."""

    @abc.abstractmethod
    def matvec_step(self, step: Any, z: Float[Array, "p *paths"]) -> Float[Array, "n *paths"]:
        """Δ_t z."""

    @abc.abstractmethod
    def steps_back(self, z: Float[Array, "T p"]) -> Any:
        """What varies in time on the way back, after Δ_t was applied to z_t for every t."""

    @abc.abstractmethod
    def rmatvec_step(self, step: Any, y: Float[Array, "n *paths"]) -> Float[Array, "p *paths"]:
        """Δ_tᵀ y, given a step of the way back."""


class Draws(PathDraws):
    """One draw of Δ_0, ..., Δ_{T-1} as linear operators from R^p to R^n, p = n, or n+m for performative B."""

    def steps_back(self, z: Array) -> Any:
        return self.steps

    @abc.abstractmethod
    def dense(self) -> Float[Array, "T n p"]:
        """The matrices."""

    def matvec(self, z: Float[Array, "T p"]) -> Float[Array, "T n"]:
        """Δ_t z_t for every t."""
        return jax.vmap(self.matvec_step)(self.steps, z)

    def rmatvec(self, y: Float[Array, "T n"]) -> Float[Array, "T p"]:
        """Δ_tᵀ y_t for every t."""
        return jax.vmap(self.rmatvec_step)(self.steps, y)


class DenseDraws(Draws):
    """Draws held as matrices."""

    matrices: Float[Array, "T n p"]
    side_by_side: ClassVar[bool] = True

    @property
    def steps(self) -> Any:
        return self.matrices

    def matvec_step(self, step: Any, z: Array) -> Array:
        return times(step, z)

    def rmatvec_step(self, step: Any, y: Array) -> Array:
        return times_transposed(step, y)

    def dense(self) -> Array:
        return self.matrices


class MetDraws(Draws):
    """Draws whose matrix at a time is made whenever it is met."""

    @abc.abstractmethod
    def matrix(self, step: Any) -> Float[Array, "n p"]:
        """Δ_t."""

    def matvec_step(self, step: Any, z: Array) -> Array:
        return matvec(self.matrix(step), z)

    def rmatvec_step(self, step: Any, y: Array) -> Array:
        return rmatvec(self.matrix(step), y)

    def dense(self) -> Array:
        return jax.vmap(self.matrix)(self.steps)


class CovarianceOperator(eqx.Module):
    """X -> E[(Δ_t - EΔ_t) X (Δ_t - EΔ_t)ᵀ] and its adjoint X -> E[(Δ_t - EΔ_t)ᵀ X (Δ_t - EΔ_t)]."""

    @property
    @abc.abstractmethod
    def steps(self) -> Any:
        """What varies in time, a pytree with leading axis T."""

    @abc.abstractmethod
    def apply_step(self, step: Any, X: Float[Array, "p p"]) -> Float[Array, "n n"]:
        """E[(Δ-Θ) X (Δ-Θ)ᵀ] at one time."""

    @abc.abstractmethod
    def adjoint_step(self, step: Any, X: Float[Array, "n n"]) -> Float[Array, "p p"]:
        """E[(Δ-Θ)ᵀ X (Δ-Θ)] at one time."""

    def backward(self, F: Matrix) -> tuple[Any, Callable[[Any, Array], Array]]:
        """Steps, and (step, X) -> FᵀXF + `adjoint_step`: for a loop over time in which F (n, n) stays the same."""
        left = transpose(F)  # outside the loop, where it is done once
        return self.steps, lambda step, X: left @ X @ F + self.adjoint_step(step, X)

    def apply(self, X: Array) -> Float[Array, "T n n"]:
        """`apply_step` for every t, X of shape (p, p) or (T, p, p)."""
        return jax.vmap(self.apply_step, in_axes=(0, 0 if X.ndim == 3 else None))(self.steps, X)

    def adjoint(self, X: Array) -> Float[Array, "T p p"]:
        """`adjoint_step` for every t, X of shape (n, n) or (T, n, n)."""
        return jax.vmap(self.adjoint_step, in_axes=(0, 0 if X.ndim == 3 else None))(self.steps, X)


class AbstractPerturbation(eqx.Module):
    """A law D_t(M) of the perturbation Δ_t, independent over time; M is the lifted policy (memory, input, state).

    `mean`, `covariance`, `bound` and `sensitivity` may return None for "unknown": then the exact engine, or the
    certificates that need them, say so.
    """

    @abc.abstractmethod
    def sample(self, key: Key[Array, ""], M: Array, horizon: int) -> Draws:
        """One draw of Δ_0..Δ_{T-1} under the deployed policy M."""

    def sample_along(self, key: Key[Array, ""], M: Array, horizon: int) -> PathDraws:
        """A draw that serves one path and its gradient, where that is cheaper than whole matrices; of the same law."""
        return self.sample(key, M, horizon)

    @abc.abstractmethod
    def mean(self, M: Array, horizon: int) -> Float[Array, "T n p"] | None:
        """Θ_t(M) = E Δ_t."""

    @abc.abstractmethod
    def covariance(self, M: Array, horizon: int) -> CovarianceOperator | None:
        """The covariance operator of Δ_t under M."""

    @abc.abstractmethod
    def bound(self, feasible_set: Any, horizon: int) -> Float[Array, " T"] | None:
        """ξ_t ≥ ‖Δ_t‖ (spectral norm) almost surely for every policy of the set."""

    @abc.abstractmethod
    def sensitivity(self, feasible_set: Any, horizon: int) -> Float[Array, " T"] | None:
        """ε_t ≥ W₁(D_t(M), D_t(M')) / ‖M - M'‖_F over the set, spectral norm as ground metric."""

    def mean_operator(self, M: Array, horizon: int) -> Matrix | None:
        """`mean` as the engines use it: None where it is zero for certain, a `Diagonal` where it is diagonal."""
        return self.mean(M, horizon)

    def columns(self, state_size: int, input_size: int) -> int:
        """p: n if Δ acts on the state alone, n+m if on [x; u]."""
        return state_size

    def resize(self, policy_shape: tuple[int, int, int], horizon: int) -> "AbstractPerturbation":
        """This law with all its sizes known, where they follow from the problem's."""
        return self

    def check(self, policy_shape: tuple[int, int, int], horizon: int) -> None:
        """Raise InputError where this law does not fit a problem of that shape; looks at shapes only."""

    def log_probability(self, draws: Draws, M: Array, horizon: int) -> Array | None:
        """log P(draws) under M where draws of a fixed key stay put as M moves; None where they move with it, smoothly.

        Sampled derivatives by the deployed policy then follow the probability (score function), else the draws.
        """
        return None

    def policy_free_mean(self, feasible_set: Any) -> bool:
        """Whether the family knows E Δ_t to be the same for every policy of the set."""
        return False

    def mean_derivative(self) -> Array | None:
        """d E Δ_t/dM where it is the same at every policy, (T, n, p, memory, m, n) or without T; else None."""
        return None


def varying(matrices: Array | None) -> Array | None:
    """`matrices` where they have a time axis: what stays the same is kept out of time loops, and held once."""
    return matrices if matrices is not None and matrices.ndim == 3 else None


def zero_mean(M: Array, horizon: int, columns: int) -> Array:
    """Θ_t = 0."""
    return jnp.zeros((horizon, M.shape[-1], columns), M.dtype)
