"""Entries uniform on intervals."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from perfcontrol._checks import fail, is_concrete
from perfcontrol.random_vectors.entrywise import Entrywise, paired


class Uniform(Entrywise):
    """Independent entries, uniform on [low_i, high_i].

    Args:
        low: (n,) or a number, in the units of the state.
        high: likewise, not below `low`.

    Raises:
        InputError: shapes that do not fit, or low > high.
    """

    low: Array
    high: Array

    def __init__(self, low: Any, high: Any):
        self.low, self.high = paired("low", low, "high", high)
        if is_concrete(self.low) and is_concrete(self.high) and np.any(np.asarray(self.low) > self.high):
            raise fail("low", f"{self.low} > {self.high}", "not exceed `high`", "Swap the two arguments.")

    @property
    def mean(self) -> Array:
        return jnp.atleast_1d((self.low + self.high) / 2)

    @property
    def covariance(self) -> Array:
        return jnp.diag(jnp.atleast_1d((self.high - self.low) ** 2 / 12))

    @property
    def bound(self) -> Array:
        return jnp.linalg.norm(jnp.atleast_1d(jnp.maximum(jnp.abs(self.low), jnp.abs(self.high))))

    def sample(self, key: Key[Array, ""], horizon: int) -> Array:
        low, high = jnp.atleast_1d(self.low), jnp.atleast_1d(self.high)
        return low + (high - low) * jax.random.uniform(key, (horizon, *low.shape), low.dtype)
