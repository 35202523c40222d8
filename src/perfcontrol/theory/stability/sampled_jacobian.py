"""The Jacobian 𝒥 of one sample gradient at a policy, the sampling law included, and means of 𝒥X𝒥ᵀ.

𝒥 = d/dM ∇_1 J(M; ω, D(M)) along one path, the randomness ω (noise, and what the perturbation is made of) held
fixed: the law D_t(M) moves with M by reparameterisation. E 𝒥 = 𝐇 + 𝐄. Small problems hold the matrices; for large
ones products with random vectors give unbiased estimates of E 𝒥X𝒥ᵀ and E 𝒥ᵀL𝒥 at one product a sample.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from perfcontrol.evaluate.adjoint import mean_path_gradient
from perfcontrol.evaluate.rollout import lanes
from perfcontrol.problem import PerformativeProblem

DENSE_ENTRIES = 20_000_000  # samples × q² that are held at once


def _gradient(problem: PerformativeProblem, M: Array, key: Key[Array, ""]) -> Array:
    return mean_path_gradient(problem, M, M, key, 1)


@eqx.filter_jit
def sample_gradients(problem: PerformativeProblem, M: Array, keys: Array) -> Array:
    """(S, p): sample gradients at M with M deployed."""
    return jax.lax.map(lambda key: _gradient(problem, M, key).reshape(-1), keys, batch_size=lanes(problem))


@eqx.filter_jit
def _matrices(problem: PerformativeProblem, M: Array, basis: Array, keys: Array) -> Array:
    tangents = basis.T.reshape(-1, *M.shape)

    def one(key: Array) -> Array:
        _, push = jax.linearize(lambda V: _gradient(problem, V, key), M)
        return (jax.vmap(push)(tangents).reshape(len(tangents), -1) @ basis).T

    return jax.lax.map(one, keys, batch_size=2)


@eqx.filter_jit
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


class JacobianSamples:
    """Samples of 𝒥 in the coordinates of `basis` (p, q): means of 𝒥X𝒥ᵀ and of its adjoint 𝒥ᵀL𝒥.

    Args:
        M: the policy (free parameters). basis: (p, q), orthonormal columns. key: of the samples. count: S.
        matrices: hold the S matrices; None decides by size.
    """

    def __init__(
        self,
        problem: PerformativeProblem,
        M: Array,
        basis: np.ndarray,
        key: Array,
        count: int,
        matrices: bool | None = None,
    ):
        self.problem, self.M, self.count = problem, M, count
        self.basis = jnp.asarray(basis, M.dtype)
        self.keys = jax.random.split(key, count)
        q = basis.shape[1]
        self.held: np.ndarray | None = None
        if count * q * q <= DENSE_ENTRIES if matrices is None else matrices:
            self.held = np.asarray(_matrices(problem, M, self.basis, self.keys), dtype=float)
        else:
            self.normal = np.random.default_rng(int(jax.random.bits(key))).standard_normal((count, q))

    def mean_square(self, X: np.ndarray) -> np.ndarray:
        """The sample mean of 𝒥X𝒥ᵀ for positive semidefinite X, (q, q)."""
        if self.held is not None:
            left = (self.held @ X).transpose(1, 0, 2).reshape(X.shape[0], -1)
            return left @ self.held.transpose(1, 0, 2).reshape(X.shape[0], -1).T / self.count
        images = self._images(X, False)
        return images.T @ images / self.count

    def adjoint(self, L: np.ndarray) -> np.ndarray:
        """The sample mean of 𝒥ᵀL𝒥 for positive semidefinite L, (q, q)."""
        if self.held is not None:
            stacked = self.held.reshape(-1, L.shape[0])
            return stacked.T @ (L @ self.held).reshape(-1, L.shape[0]) / self.count
        images = self._images(L, True)
        return images.T @ images / self.count

    def values(self, L: np.ndarray, X: np.ndarray) -> np.ndarray:
        """tr L𝒥X𝒥ᵀ of every sample (or unbiased estimates of it), (S,)."""
        if self.held is not None:
            return np.einsum("sij,sij->s", L @ self.held, self.held @ X)
        images = self._images(X, False)
        return np.einsum("si,ij,sj->s", images, L, images)

    def _images(self, X: np.ndarray, transposed: bool) -> np.ndarray:
        values, vectors = np.linalg.eigh((X + X.T) / 2)
        probes = self.normal @ (vectors * np.sqrt(np.maximum(values, 0))).T
        products = _products(self.problem, self.M, self.basis, self.keys, jnp.asarray(probes, self.M.dtype), transposed)
        return np.asarray(products, dtype=float)
