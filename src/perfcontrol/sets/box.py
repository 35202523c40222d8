"""Policies whose entries lie between two bounds."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import as_array, fail, is_concrete
from perfcontrol.sets.base import AbstractSet


class Box(AbstractSet):
    """{M : low ≤ M ≤ high, entry by entry}.

    Args:
        low: a number or one per free parameter, (memory, input, state); -inf and inf leave entries free.
        high: likewise, not below `low`.

    Raises:
        InputError: low > high somewhere (the set is empty), or arrays that do not fit the policy.
    """

    low: Array
    high: Array

    def __init__(self, low: Any, high: Any):
        self.low, self.high = _limit("low", low), _limit("high", high)
        if is_concrete(self.low) and is_concrete(self.high):
            try:
                crossed = bool(jnp.any(self.low > self.high))
            except (TypeError, ValueError) as error:
                required = f"fit `high` of shape {self.high.shape}"
                raise fail("low", f"{self.low.shape}", required, "Give both the policy's shape.") from error
            if crossed:
                gap = float(jnp.max(self.low - self.high))
                raise fail(
                    "low", f"low - high = {gap:.3g} at most", "not exceed `high`: the set is empty", "Swap them."
                )

    def check(self, shape: tuple[int, ...]) -> None:
        for name, limit in (("low", self.low), ("high", self.high)):
            if limit.ndim and limit.shape != shape:
                raise fail(
                    name,
                    f"{limit.shape}",
                    f"be a number or have shape (memory, input, state) = {shape}",
                    "Pass one bound per free parameter.",
                )

    def project(self, M: Array) -> Array:
        low, high = self.low.astype(M.dtype), self.high.astype(M.dtype)
        # Not `clip`: an entry that two equal bounds fix must have derivative zero there as well.
        inside = (low < M) & (high > M)
        return jnp.where(inside, M, jnp.where(low >= M, low, high))

    def support(self, direction: Array) -> Array | None:
        """Σ max(low d, high d); None where a bound is infinite."""
        if not self._bounded():
            return None
        return jnp.sum(jnp.where(direction > 0, self.high, self.low) * direction, axis=(-3, -2, -1))

    def farthest(self, center: Array) -> Array | None:
        """At a corner."""
        if not self._bounded():
            return None
        return jnp.linalg.norm(jnp.maximum(jnp.abs(self.low - center), jnp.abs(self.high - center)).reshape(-1))

    def radius(self, shape: tuple[int, ...]) -> Array | None:
        return self.farthest(jnp.zeros(shape, self.low.dtype))

    def _bounded(self) -> bool:
        """Whether both bounds are finite; traced ones are taken to be."""
        return all(not is_concrete(limit) or bool(jnp.all(jnp.isfinite(limit))) for limit in (self.low, self.high))

    @property
    def nonnegative(self) -> bool:
        return is_concrete(self.low) and bool(jnp.all(self.low >= 0))


def _limit(name: str, value: Any) -> Array:
    """An array as `as_array` reads it, infinite entries allowed."""
    if not is_concrete(value):
        return as_array(name, value)
    host = np.asarray(value)
    if host.dtype.kind not in "fiub":
        return as_array(name, value)  # raises the usual error
    finite = as_array(name, np.where(np.isinf(host), 0.0, host))
    return jnp.where(np.isinf(host), jnp.asarray(host, finite.dtype), finite)
