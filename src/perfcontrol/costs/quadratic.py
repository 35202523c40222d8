"""Quadratic stage cost, about moving targets: xᵀQx + uᵀRu + 2 xᵀ cross u, without a factor one half."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._checks import as_array, check_symmetric_psd, check_time_varying, fail
from perfcontrol._linalg import along_time, transpose
from perfcontrol.costs.base import AbstractCost, as_discount, check_discount, stage_factors


class QuadraticForm(NamedTuple):
    """zᵀ matrix z + 2 linearᵀ z + constant on z = [x; u], for t = 0..T."""

    matrix: Float[Array, "T1 p p"]
    linear: Float[Array, "T1 p"]
    constant: Float[Array, " T1"]


class QuadraticCost(AbstractCost):
    """discount^t [(x-x*)ᵀQ(x-x*) + (u-u*)ᵀR(u-u*) + 2 (x-x*)ᵀ cross (u-u*)].

    Args:
        Q: (n, n) or (T+1, n, n).
        R: (m, m) or (T+1, m, m).
        cross: (n, m) or (T+1, n, m), or None.
        state_target: x*, (n,) or (T+1, n), or None for zero.
        input_target: u*, (m,) or (T+1, m), or None for zero.
        discount: what a stage counts beside the one before it, in (0, 1].

    Raises:
        InputError: Q, R or the joint matrix [[Q, cross], [crossᵀ, R]] asymmetric or indefinite; a discount outside
            (0, 1].
    """

    Q: Array
    R: Array
    cross: Array | None
    state_target: Array | None
    input_target: Array | None
    discount: Array | None  # None: 1

    def __init__(
        self,
        Q: Any,
        R: Any,
        cross: Any = None,
        state_target: Any = None,
        input_target: Any = None,
        discount: Any = 1.0,
    ):
        self.discount = as_discount(discount)
        self.Q, self.R = as_array("Q", Q), as_array("R", R)
        self.cross = None if cross is None else as_array("cross", cross)
        self.state_target = None if state_target is None else as_array("state_target", state_target)
        self.input_target = None if input_target is None else as_array("input_target", input_target)
        for name, weight in (("Q", self.Q), ("R", self.R)):
            if weight.ndim not in (2, 3) or weight.shape[-1] != weight.shape[-2]:
                raise fail(
                    name,
                    f"{weight.shape}",
                    "be square: (n, n) or (T+1, n, n)",
                    "Pass [[q]] for a scalar weight.",
                )
            check_symmetric_psd(name, weight, "The stage cost must be convex.")
        if self.cross is not None:
            n, m = self.Q.shape[-1], self.R.shape[-1]
            if self.cross.shape[-2:] != (n, m):
                swapped = (
                    "The last two axes look swapped: pass its transpose." if self.cross.shape[-2:] == (m, n) else ""
                )
                raise fail(
                    "cross",
                    f"{self.cross.shape}",
                    f"have shape (n, m) = ({n}, {m})",
                    swapped or "Put states in rows, inputs in columns.",
                )
            weights = {"Q": self.Q, "R": self.R, "cross": self.cross}
            length = max(w.shape[0] if w.ndim == 3 else 1 for w in weights.values())
            for name, w in weights.items():
                if w.ndim == 3 and w.shape[0] != length:
                    required = f"have as many time steps as the other weights: {length}"
                    raise fail(name, f"{w.shape[0]}", required, "Give one weight per stage t = 0..T, or a constant.")
            check_symmetric_psd(
                "cross",
                self._joint(length),
                "[[Q, cross], [crossᵀ, R]] must be convex: make `cross` smaller.",
            )

    def check(self, state_size: int, input_size: int, horizon: int | float) -> None:
        n, m, length = state_size, input_size, horizon + 1
        check_discount(self.discount, horizon)
        shapes = {
            "Q": (self.Q, (n, n), ("n", "n")),
            "R": (self.R, (m, m), ("m", "m")),
            "cross": (self.cross, (n, m), ("n", "m")),
            "state_target": (self.state_target, (n,), ("n",)),
            "input_target": (self.input_target, (m,), ("m",)),
        }
        for name, (value, inner, labels) in shapes.items():
            if value is not None:
                check_time_varying(name, value, inner, labels, length, "T+1")

    def weights(self, horizon: int) -> tuple[Array, Array, Array | None]:
        """Q, R and cross with the discount folded in; each with a leading axis T+1 where it varies in time."""
        if self.discount is None:
            return self.Q, self.R, self.cross
        factors = stage_factors(self.discount, horizon + 1)[:, None, None]
        return factors * self.Q, factors * self.R, None if self.cross is None else factors * self.cross

    def _joint(self, length: int) -> Array:
        """[[Q, cross], [crossᵀ, R]] for every time."""
        n, m = self.Q.shape[-1], self.R.shape[-1]
        Q, R, cross = self.weights(length - 1)
        Q, R = along_time(Q, 2, length), along_time(R, 2, length)
        cross = jnp.zeros((length, n, m), Q.dtype) if cross is None else along_time(cross, 2, length)
        return jnp.concatenate(
            [jnp.concatenate([Q, cross], axis=-1), jnp.concatenate([transpose(cross), R], axis=-1)], axis=-2
        )

    def form(self, horizon: int) -> QuadraticForm:
        """The cost as a quadratic form on z = [x; u] for t = 0..horizon."""
        linear, constant = self.linear_terms(horizon)
        return QuadraticForm(self._joint(horizon + 1), linear, constant)

    @property
    def has_targets(self) -> bool:
        """Whether the form has linear terms."""
        return self.state_target is not None or self.input_target is not None

    def linear_terms(self, horizon: int) -> tuple[Float[Array, "T1 p"], Float[Array, " T1"]]:
        """`linear` and `constant` of the form: the half gradients at z = 0, and what the targets cost there."""
        n, m = self.Q.shape[-1], self.R.shape[-1]
        x, u = (jnp.zeros((horizon + 1, size), self.Q.dtype) for size in (n, m))
        by_state, by_input = self._half_gradients(*self._centred(x, u))
        return jnp.concatenate([by_state, by_input], axis=-1), self.path_cost(x, u)

    def _centred(self, x: Array, u: Array) -> tuple[Array, Array]:
        x = x if self.state_target is None else x - self.state_target
        u = u if self.input_target is None else u - self.input_target
        return x, u

    def _half_gradients(self, x: Array, u: Array) -> tuple[Array, Array]:
        def times(weight: Array, vectors: Array) -> Array:
            if weight.ndim == 2:
                return vectors @ weight.T
            return jnp.einsum("tij,tj->ti", weight, vectors)

        Q, R, cross = self.weights(len(x) - 1)
        by_state, by_input = times(Q, x), times(R, u)
        if cross is not None:
            by_state = by_state + times(cross, u)
            by_input = by_input + times(transpose(cross), x)
        return by_state, by_input

    def path_cost(self, x: Array, u: Array) -> Array:
        x, u = self._centred(x, u)
        by_state, by_input = self._half_gradients(x, u)
        return jnp.sum(x * by_state, axis=-1) + jnp.sum(u * by_input, axis=-1)

    def path_gradients(self, x: Array, u: Array) -> tuple[Array, Array]:
        by_state, by_input = self._half_gradients(*self._centred(x, u))
        return 2 * by_state, 2 * by_input
