"""The interface of a stage cost c_t(x, u), summed over t = 0..T."""

import abc

import equinox as eqx
from jaxtyping import Array, Float


class AbstractCost(eqx.Module):
    """c_t(x, u), evaluated in bulk along a whole path."""

    @abc.abstractmethod
    def path_cost(self, x: Float[Array, "T1 n"], u: Float[Array, "T1 m"]) -> Float[Array, " T1"]:
        """c_t(x_t, u_t) for t = 0..T."""

    @abc.abstractmethod
    def path_gradients(
        self, x: Float[Array, "T1 n"], u: Float[Array, "T1 m"]
    ) -> tuple[Float[Array, "T1 n"], Float[Array, "T1 m"]]:
        """∇_x c_t and ∇_u c_t along the path."""

    @abc.abstractmethod
    def check(self, state_size: int, input_size: int, horizon: int) -> None:
        """Raise InputError where the cost does not fit a problem of that shape."""
