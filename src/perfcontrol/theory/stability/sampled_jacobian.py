"""The Jacobian 𝒥 of one sample gradient at a policy, the sampling law included, and means of 𝒥X𝒥ᵀ.

𝒥 = d/dM ∇_1 J(M; ω, D(M)) along one path, the randomness ω (noise, and what the perturbation is made of) held
fixed: the law D_t(M) moves with M by reparameterisation. E 𝒥 = 𝐇 + 𝐄. Small problems hold the matrices; for large
ones products with random vectors give unbiased estimates of E 𝒥X𝒥ᵀ and E 𝒥ᵀL𝒥 at one product a sample.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from perfcontrol._programs import program
from perfcontrol.evaluate.adjoint import mean_path_gradient
from perfcontrol.evaluate.paths import lanes
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.precision import in_double

DENSE_ENTRIES = 20_000_000  # samples × q² that are held at once
GRADIENTS = 4  # sample gradients for each sampled Jacobian


def _gradient(problem: PerformativeProblem, M: Array, key: Key[Array, ""]) -> Array:
    return mean_path_gradient(problem, M, M, key, 1)


@program
def sample_gradients(problem: PerformativeProblem, M: Array, keys: Array) -> Array:
    """(S, p): sample gradients at M with M deployed."""
    return jax.lax.map(lambda key: _gradient(problem, M, key).reshape(-1), keys, batch_size=lanes(problem))


@program
def _matrices(problem: PerformativeProblem, M: Array, basis: Array, key: Array, half: int) -> tuple[Array, Array]:
    """Jacobians (2, half, q, q) and gradients (S, q), in `basis`.

    One copy of the path serves both: what a Jacobian adds to its gradient stands in a branch.
    """
    tangents = basis.T.reshape(-1, *M.shape)
    q = len(tangents)
    first, second, gradient_key = jax.random.split(key, 3)
    keys = jnp.concatenate([jax.random.split(first, half), jax.random.split(second, half)])
    more = jax.random.split(gradient_key, GRADIENTS * len(keys)).reshape(len(keys), GRADIENTS)

    def one(at: tuple[Array, Array]) -> tuple[Array, Array]:
        key, wanted = at
        gradient, push = jax.linearize(lambda V: _gradient(problem, V, key), M)

        def matrix() -> Array:
            return (jax.vmap(push)(tangents).reshape(q, -1) @ basis).T

        return gradient.reshape(-1) @ basis, jax.lax.cond(wanted, matrix, lambda: jnp.zeros((q, q), M.dtype))

    def row(keys: tuple[Array, Array]) -> tuple[Array, Array]:
        wanted = jnp.arange(1 + GRADIENTS) == 0
        gradients, matrices = jax.lax.map(one, (jnp.concatenate([keys[0][None], keys[1]]), wanted))
        return matrices[0], gradients[1:]

    matrices, gradients = jax.lax.map(row, (keys, more))
    return matrices.reshape(2, half, q, q), gradients.reshape(-1, q)


@program
def _products(
    problem: PerformativeProblem, M: Array, basis: Array, keys: Array, vectors: Array, transposed: bool
) -> Array:
    def one(pair: Any) -> Array:
        key, vector = pair
        direction = (basis @ vector).reshape(M.shape)

        def gradient(V: Array) -> Array:
            return _gradient(problem, V, key)

        if transposed:
            image = jax.vjp(gradient, M)[1](direction)[0]
        else:
            image = jax.jvp(gradient, (M,), (direction,))[1]
        return image.reshape(-1) @ basis

    return jax.lax.map(one, (keys, vectors), batch_size=lanes(problem))


@dataclass(frozen=True)
class HeldJacobians:
    """Samples of 𝒥 as matrices, (S, q, q): means of 𝒥X𝒥ᵀ and of its adjoint 𝒥ᵀL𝒥."""

    matrices: np.ndarray

    def mean_square(self, X: np.ndarray) -> np.ndarray:
        """The sample mean of 𝒥X𝒥ᵀ for positive semidefinite X, (q, q)."""
        q = len(X)
        left = (self.matrices @ X).transpose(1, 0, 2).reshape(q, -1)
        return left @ self.matrices.transpose(1, 0, 2).reshape(q, -1).T / len(self.matrices)

    def adjoint(self, L: np.ndarray) -> np.ndarray:
        """The sample mean of 𝒥ᵀL𝒥 for positive semidefinite L, (q, q)."""
        q = len(L)
        return self.matrices.reshape(-1, q).T @ (L @ self.matrices).reshape(-1, q) / len(self.matrices)

    def values(self, L: np.ndarray, X: np.ndarray) -> np.ndarray:
        """tr L𝒥X𝒥ᵀ of every sample, (S,)."""
        return np.einsum("sij,sij->s", L @ self.matrices, self.matrices @ X)


class ProbedJacobians:
    """The same by products with random vectors, for Jacobians too large to hold: unbiased estimates."""

    def __init__(self, problem: PerformativeProblem, M: np.ndarray, basis: np.ndarray, key: Array, count: int):
        self.problem, self.M, self.basis = problem, M, basis
        self.keys = jax.random.split(key, count)
        self.normal = np.random.default_rng(int(jax.random.bits(key))).standard_normal((count, basis.shape[1]))

    def mean_square(self, X: np.ndarray) -> np.ndarray:
        """The sample mean of 𝒥X𝒥ᵀ for positive semidefinite X, (q, q)."""
        images = self._images(X, False)
        return images.T @ images / len(images)

    def adjoint(self, L: np.ndarray) -> np.ndarray:
        """The sample mean of 𝒥ᵀL𝒥 for positive semidefinite L, (q, q)."""
        images = self._images(L, True)
        return images.T @ images / len(images)

    def values(self, L: np.ndarray, X: np.ndarray) -> np.ndarray:
        """Unbiased estimates of tr L𝒥X𝒥ᵀ of every sample, (S,)."""
        images = self._images(X, False)
        return np.einsum("si,ij,sj->s", images, L, images)

    @in_double
    def _images(self, X: np.ndarray, transposed: bool) -> np.ndarray:
        values, vectors = np.linalg.eigh((X + X.T) / 2)
        probes = self.normal @ (vectors * np.sqrt(np.maximum(values, 0))).T
        vectors = probes.astype(self.M.dtype)
        return _products(self.problem, self.M, self.basis, self.keys, vectors, transposed).astype(float)


class JacobianSamples(NamedTuple):
    """Two independent halves of the sampled Jacobians, and more sample gradients (S, q), in a basis (p, q)."""

    halves: tuple[HeldJacobians, HeldJacobians] | tuple[ProbedJacobians, ProbedJacobians]
    gradients: np.ndarray


def sample_jacobians(
    problem: PerformativeProblem, M: Any, basis: np.ndarray, key: Array, samples: int, held: bool | None = None
) -> JacobianSamples:
    """Sampled Jacobians and gradients at a policy, the policy itself deployed.

    Args:
        problem: the problem.
        M: the policy (free parameters).
        basis: (p, q), orthonormal columns.
        key: of the samples.
        samples: Jacobians in both halves together; there are four times as many gradients.
        held: whether the matrices are held; None decides by size.
    """
    M, half = np.asarray(M), samples // 2
    columns = basis.astype(M.dtype)
    if half * basis.shape[1] ** 2 <= DENSE_ENTRIES if held is None else held:
        matrices, gradients = _matrices(problem, M, columns, key, half)
        first, second = (HeldJacobians(some.astype(float)) for some in matrices)
        return JacobianSamples((first, second), gradients.astype(float))
    first_key, second_key, gradient_key = jax.random.split(key, 3)
    first, second = (ProbedJacobians(problem, M, columns, k, half) for k in (first_key, second_key))
    gradients = sample_gradients(problem, M, jax.random.split(gradient_key, 2 * GRADIENTS * half))
    return JacobianSamples((first, second), gradients.astype(float) @ basis)
