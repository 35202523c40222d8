"""Entries of two values, equally likely."""

import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import check_nonnegative
from perfcontrol.random_keys import random_words
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


def random_signs(key: Key[Array, "*keys"], shape: tuple[int, ...], dtype: Any) -> Array:
    """Independent ±1, thirty-two from each random word, (*shape, *keys)."""
    count = math.prod(shape)
    words = random_words(key, -(-count // 32), 32)
    bits = (words[:, None] >> jnp.arange(32, dtype=jnp.uint32).reshape(32, *[1] * key.ndim)) & 1
    bits = bits.reshape(-1, *key.shape)[:count].reshape(*shape, *key.shape)
    return 2 * bits.astype(dtype) - 1
