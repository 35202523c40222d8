"""The interface of a linear structure."""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array


class AbstractStructure(eqx.Module):
    """An injective linear map 𝓛 from free parameters to policies, with 𝓛ᵀ𝓛 = norm² I."""

    @abc.abstractmethod
    def lift(self, parameters: Array) -> Array:
        """𝓛 applied to free parameters."""

    @abc.abstractmethod
    def adjoint(self, M: Array) -> Array:
        """𝓛ᵀ applied to a policy: turns gradients by M into gradients by the free parameters."""

    @abc.abstractmethod
    def free_shape(self, policy_shape: tuple[int, int, int]) -> tuple[int, int, int]:
        """Shape of the free parameters of policies of that shape."""

    def product_matrix(self, left: Array, right: Array, shape: tuple[int, int, int]) -> Array:
        """The matrix (p, p) of V -> 𝓛ᵀ(left · 𝓛V · right) on free parameters of that shape.

        left: (H m, H m), acts on the lags' rows together. right: (n, n).
        """
        size = math.prod(shape)

        def column(direction: Array) -> Array:
            V = self.lift(direction.reshape(shape))
            image = left @ (V @ right).reshape(len(left), -1)
            return self.adjoint(image.reshape(V.shape)).reshape(-1)

        return jax.lax.map(column, jnp.eye(size, dtype=left.dtype), batch_size=min(64, size)).T

    @property
    @abc.abstractmethod
    def norm(self) -> float:
        """‖𝓛‖."""
