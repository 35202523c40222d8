"""The interface of a linear structure."""

import abc

import equinox as eqx
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

    @property
    @abc.abstractmethod
    def norm(self) -> float:
        """‖𝓛‖."""
