"""The interface of a law of random vectors: the noise w_t and the initial state x_0.

A law answers `sample(key, horizon)` with independent draws, shape (horizon, n), and knows its `mean`, its
`covariance` (both without a time axis unless the law varies in time) and its almost-sure Euclidean `bound`.
Covariance is always about the mean; second moments are never stored.
"""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, Key


class AbstractRandomVector(eqx.Module):
    """A law of independent random vectors of dimension n."""

    @property
    @abc.abstractmethod
    def mean(self) -> Array:
        """Mean, shape (n,), or (T, n) if it varies in time."""

    @property
    @abc.abstractmethod
    def covariance(self) -> Array:
        """Covariance about the mean, shape (n, n), or (T, n, n) if it varies in time."""

    @property
    @abc.abstractmethod
    def bound(self) -> Array | None:
        """A number that the Euclidean norm almost surely does not exceed; None if unbounded."""

    @abc.abstractmethod
    def sample(self, key: Key[Array, ""], horizon: int) -> Float[Array, "horizon n"]:
        """Independent draws for t = 0..horizon-1."""

    @property
    def entry_range(self) -> tuple[Any, Any] | None:
        """Two numbers between which every entry almost surely lies; None if unbounded."""
        return None if self.bound is None else (-self.bound, self.bound)

    def resize(self, size: int) -> "AbstractRandomVector":
        """This law in dimension `size`: scalar parameters are repeated, anything else must fit already."""
        return self

    @property
    def size(self) -> int:
        """Dimension n."""
        return self.mean.shape[-1]
