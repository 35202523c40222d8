"""Perturbations known only through a sampler: for simulation."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, check_nonnegative, fail
from perfcontrol._functions import as_callable, call
from perfcontrol.perturbations.base import AbstractPerturbation, CovarianceOperator, DenseDraws, Draws


class SampledPerturbation(AbstractPerturbation):
    """Δ_0, ..., Δ_{T-1} from a user's sampler. Moments are unknown, so exact evaluation and solvers refuse it.

    Args:
        sampler: (key, M) -> (T, n, n), or (T, n, n+m) to act on [x; u]; independent over time, M the lifted deployed
            policy. A plain function is static; numbers to sweep belong in an eqx.Module or jax.tree_util.Partial.
        bound: ξ_t ≥ ‖Δ_t‖ over the feasible set, a number or (T,), declared; None for unknown.
        sensitivity: ε_t in Wasserstein-1 distance per unit of Frobenius norm, declared likewise.
        columns: p, the columns of a draw; None: found when the problem is built.

    Raises:
        InputError: negative numbers, or a sampler that does not fit (when the problem is built).
    """

    sampler: Callable
    declared_bound: Array | None
    declared_sensitivity: Array | None
    width: int | None = eqx.field(static=True)

    def __init__(self, sampler: Any, bound: Any = None, sensitivity: Any = None, columns: int | None = None):
        self.sampler = as_callable("sampler", sampler)
        self.declared_bound = _declared("bound", bound)
        self.declared_sensitivity = _declared("sensitivity", sensitivity)
        self.width = columns

    def _shape(self, policy_shape: tuple[int, int, int]) -> tuple[int, ...]:
        policy = jax.ShapeDtypeStruct(policy_shape, jnp.result_type(float))
        key = jax.eval_shape(lambda: jax.random.key(0))
        return eqx.filter_eval_shape(lambda law, key, M: law._draw(key, M), self, key, policy).shape

    def _draw(self, key: Key[Array, ""], M: Array) -> Array:
        return call("sampler", lambda key, M: jnp.asarray(self.sampler(key, M)), key=key, M=M)

    def resize(self, policy_shape: tuple[int, int, int], horizon: int) -> "SampledPerturbation":
        """This law knowing how many columns its draws have."""
        shape = self._shape(policy_shape)
        width = shape[-1] if shape else None
        return SampledPerturbation(self.sampler, self.declared_bound, self.declared_sensitivity, width)

    def columns(self, state_size: int, input_size: int) -> int:
        return state_size if self.width is None else self.width

    def check(self, policy_shape: tuple[int, int, int], horizon: int) -> None:
        _, m, n = policy_shape
        shape = self._shape(policy_shape)
        if shape not in ((horizon, n, n), (horizon, n, n + m)):
            raise fail(
                "sampler",
                f"draws of shape {shape}",
                f"draw arrays of shape (T, n, n) = {(horizon, n, n)} or (T, n, n+m) = {(horizon, n, n + m)}",
                "Return such an array: the time axis comes first.",
            )
        for name, value in (("bound", self.declared_bound), ("sensitivity", self.declared_sensitivity)):
            if value is not None and value.shape not in ((), (horizon,)):
                raise fail(
                    name,
                    f"{value.shape}",
                    f"be a number or have shape (T,) = ({horizon},)",
                    "Pass one per step, or one for all.",
                )

    def sample(self, key: Key[Array, ""], M: Array, horizon: int) -> Draws:
        return DenseDraws(self._draw(key, M).astype(M.dtype))

    def mean(self, M: Array, horizon: int) -> None:
        return None

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator | None:
        return None

    def bound(self, feasible_set: Any, horizon: int) -> Array | None:
        return None if self.declared_bound is None else jnp.broadcast_to(self.declared_bound, (horizon,))

    def sensitivity(self, feasible_set: Any, horizon: int) -> Array | None:
        return None if self.declared_sensitivity is None else jnp.broadcast_to(self.declared_sensitivity, (horizon,))


def _declared(name: str, value: Any) -> Array | None:
    if value is None:
        return None
    array = as_array(name, value)
    check_nonnegative(name, array, "Pass None where it is not known.")
    return array
