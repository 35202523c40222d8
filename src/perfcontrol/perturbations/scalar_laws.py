"""Scalar laws ζ of zero mean and unit variance that scale a direction."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Key
from scipy import integrate, stats

from perfcontrol.random_vectors import random_signs

CUTOFF = 3.0  # the Gaussian is cut at this many of its own standard deviations before it is normalised
_NORMAL_SCALE = float(stats.truncnorm(-CUTOFF, CUTOFF).std())


class ScalarLaw(NamedTuple):
    """Sampler, sup |ζ| and E |ζ|."""

    sample: Callable[[Key[Array, ""], tuple[int, ...], Any], Array]
    bound: float
    mean_absolute: float


def _uniform(key: Key[Array, ""], shape: tuple[int, ...], dtype: Any) -> Array:
    return jax.random.uniform(key, shape, dtype, -math.sqrt(3), math.sqrt(3))


def _truncated_gaussian(key: Key[Array, ""], shape: tuple[int, ...], dtype: Any) -> Array:
    return jax.random.truncated_normal(key, -CUTOFF, CUTOFF, shape, dtype) / _NORMAL_SCALE


_mean_absolute_normal = 2 * integrate.quad(lambda z: z * stats.truncnorm.pdf(z, -CUTOFF, CUTOFF), 0, CUTOFF)[0]

SCALAR_LAWS = {
    "rademacher": ScalarLaw(random_signs, 1.0, 1.0),
    "uniform": ScalarLaw(_uniform, math.sqrt(3), math.sqrt(3) / 2),
    "truncated_gaussian": ScalarLaw(_truncated_gaussian, CUTOFF / _NORMAL_SCALE, _mean_absolute_normal / _NORMAL_SCALE),
}
