"""Entries of two values, equally likely."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from perfcontrol._checks import check_nonnegative
from perfcontrol.random_vectors.entrywise import Entrywise, paired


class Rademacher(Entrywise):
    """Independent entries mean_i ± scale_i with probability one half each.

    Args:
        scale: (n,) or a number, not negative.
        mean: (n,) or a number.

    Raises:
        InputError: shapes that do not fit, or a negative scale.
    """

    scale: Array
    centre: Array

    def __init__(self, scale: Any, mean: Any = 0):
        self.scale, self.centre = paired("scale", scale, "mean", mean)
        check_nonnegative("scale", self.scale, "Only its square matters: pass its absolute value.")

    @property
    def mean(self) -> Array:
        return jnp.atleast_1d(self.centre)

    @property
    def covariance(self) -> Array:
        return jnp.diag(jnp.atleast_1d(self.scale**2))

    @property
    def bound(self) -> Array:
        return jnp.linalg.norm(jnp.atleast_1d(jnp.abs(self.centre) + jnp.abs(self.scale)))

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        scale = jnp.atleast_1d(self.scale)
        return self.mean + scale * random_signs(key, (horizon, *scale.shape), scale.dtype)


def random_signs(key: Key[Array, ""], shape: tuple[int, ...], dtype: Any) -> Array:
    """Independent ±1, thirty-two from each random word."""
    count = int(np.prod(shape, dtype=int))
    words = jax.random.bits(key, ((count + 31) // 32,), jnp.uint32)
    bits = (words[:, None] >> jnp.arange(32, dtype=jnp.uint32)) & 1
    return (2 * bits.reshape(-1)[:count].astype(dtype) - 1).reshape(shape)
