"""The interface of a stage cost c_t(x, u), summed over t = 0..T."""

import abc
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._checks import as_array, fail, is_concrete


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
    def check(self, state_size: int, input_size: int, horizon: int | float) -> None:
        """Raise InputError where the cost does not fit a problem of that shape."""


def as_discount(value: Any) -> Array | None:
    """The discount factor as an array; None where it is the number 1, so that nothing is multiplied."""
    if value is None or (isinstance(value, int | float) and value == 1):
        return None
    discount = as_array("discount", value)
    if discount.ndim or (is_concrete(discount) and not 0 < float(discount) <= 1):
        raise fail(
            "discount", f"{value}", "be one number in (0, 1]", "Pass for example 0.99: stage t counts discount^t."
        )
    return discount


def check_discount(discount: Array | None, horizon: int | float) -> None:
    """Raise where costs are discounted though their average over the long run is asked for."""
    if discount is not None and math.isinf(horizon):
        required = "be 1 where the horizon is infinite: the long run does not see what is discounted"
        raise fail("discount", "another factor", required, "Leave it out, or pass a finite horizon.")


def stage_factors(discount: Array, length: int) -> Float[Array, " T1"]:
    """discount^t for t = 0..length-1."""
    return discount ** jnp.arange(length, dtype=discount.dtype)
