"""The same block for each of several subsystems."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import check_integer, fail
from perfcontrol.sets.structures.base import AbstractStructure


class RepeatedBlock(AbstractStructure):
    """(H, m/count, n/count) -> blockdiag(M, ..., M) with `count` copies in every lag.

    Args:
        count: the number of blocks; it divides m and n.
    """

    count: int = eqx.field(static=True)

    def __init__(self, count: int):
        self.count = check_integer("count", count, 1)

    def lift(self, parameters: Array) -> Array:
        H, m, n = parameters.shape
        eye = jnp.eye(self.count, dtype=parameters.dtype)
        return jnp.einsum("ab,hmn->hambn", eye, parameters).reshape(H, self.count * m, self.count * n)

    def adjoint(self, M: Array) -> Array:
        H, m, n = M.shape
        blocks = M.reshape(H, self.count, m // self.count, self.count, n // self.count)
        return jnp.einsum("haman->hmn", blocks)

    def free_shape(self, policy_shape: tuple[int, int, int]) -> tuple[int, int, int]:
        H, m, n = policy_shape
        if m % self.count or n % self.count:
            raise fail(
                "structure",
                f"m, n = {m}, {n}",
                f"divide into {self.count} equal blocks",
                "Choose a count that divides both the input and the state size.",
            )
        return H, m // self.count, n // self.count

    def product_matrix(self, left: Array, right: Array, shape: tuple[int, int, int]) -> Array:
        H, m, n = shape
        left, right = left.reshape(H, self.count, m, H, self.count, m), right.reshape(self.count, n, self.count, n)
        return jnp.einsum("haigbj,blak->hikgjl", left, right).reshape(H * m * n, H * m * n)

    @property
    def norm(self) -> float:
        return math.sqrt(self.count)
