"""No perturbation: the world does not react."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol.perturbations.base import AbstractPerturbation, CovarianceOperator, Draws, zero_mean


class _ZeroDraws(Draws):
    zeros: Array  # (T, 1): carries the horizon, and an axis that batched loops can reshape
    size: int = eqx.field(static=True)
    side_by_side: ClassVar[bool] = True

    @property
    def steps(self) -> Any:
        return self.zeros

    def matvec_step(self, step: Any, z: Array) -> Array:
        return jnp.zeros_like(z)

    def rmatvec_step(self, step: Any, y: Array) -> Array:
        return jnp.zeros_like(y)

    def dense(self) -> Array:
        return jnp.zeros((self.zeros.shape[0], self.size, self.size), self.zeros.dtype)


class _ZeroCovariance(CovarianceOperator):
    zeros: Array

    @property
    def steps(self) -> Any:
        return self.zeros

    def apply_step(self, step: Any, X: Array) -> Array:
        return jnp.zeros_like(X)

    def adjoint_step(self, step: Any, X: Array) -> Array:
        return jnp.zeros_like(X)


class NoPerturbation(AbstractPerturbation):
    """Δ_t = 0: ordinary linear-quadratic control with a disturbance-action policy."""

    def sample(self, key: Key[Array, ""], M: Array, horizon: int) -> Draws:
        return _ZeroDraws(jnp.zeros((horizon, 1), M.dtype), M.shape[-1])

    def mean(self, M: Array, horizon: int) -> Array:
        return zero_mean(M, horizon, M.shape[-1])

    def mean_operator(self, M: Array, horizon: int) -> None:
        return None

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        return _ZeroCovariance(jnp.zeros((horizon, 0), M.dtype))

    def bound(self, feasible_set: Any, horizon: int) -> Array:
        return jnp.zeros(horizon)

    def sensitivity(self, feasible_set: Any, horizon: int) -> Array:
        return jnp.zeros(horizon)

    def policy_free_mean(self, feasible_set: Any) -> bool:
        return True
