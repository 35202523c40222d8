"""Scalar laws ζ of zero mean and unit variance that scale a direction."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key

from perfcontrol.random_keys import unit_numbers
from perfcontrol.random_vectors import random_signs

CUTOFF = 3.0  # the Gaussian is cut at this many of its own standard deviations before it is normalised
_DENSITY_AT_0, _DENSITY_AT_CUTOFF = (math.exp(-(z**2) / 2) / math.sqrt(2 * math.pi) for z in (0.0, CUTOFF))
_KEPT = math.erf(CUTOFF / math.sqrt(2))  # the probability that is not cut
_NORMAL_SCALE = math.sqrt(1 - 2 * CUTOFF * _DENSITY_AT_CUTOFF / _KEPT)
_MEAN_ABSOLUTE = 2 * (_DENSITY_AT_0 - _DENSITY_AT_CUTOFF) / _KEPT


class ScalarLaw(NamedTuple):
    """Sampler, sup |ζ| and E |ζ|; several keys give draws side by side, along a last axis."""

    sample: Callable[[Key[Array, "*keys"], tuple[int, ...], Any], Array]
    bound: float
    mean_absolute: float


def _uniform(key: Key[Array, "*keys"], shape: tuple[int, ...], dtype: Any) -> Array:
    number = unit_numbers(key, math.prod(shape), dtype).reshape(*shape, *key.shape)
    return number * np.array(2 * math.sqrt(3), dtype) - np.array(math.sqrt(3), dtype)


def _truncated_gaussian(key: Key[Array, "*keys"], shape: tuple[int, ...], dtype: Any) -> Array:
    if key.ndim:
        return jax.vmap(lambda one: _truncated_gaussian(one, shape, dtype), out_axes=-1)(key)
    return jax.random.truncated_normal(key, -CUTOFF, CUTOFF, shape, dtype) / _NORMAL_SCALE


SCALAR_LAWS = {
    "rademacher": ScalarLaw(random_signs, 1.0, 1.0),
    "uniform": ScalarLaw(_uniform, math.sqrt(3), math.sqrt(3) / 2),
    "truncated_gaussian": ScalarLaw(_truncated_gaussian, CUTOFF / _NORMAL_SCALE, _MEAN_ABSOLUTE / _NORMAL_SCALE),
}
