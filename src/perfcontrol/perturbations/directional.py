"""Random multiples of fixed directions: Δ_t = mean(M)[t] + Σ_k scale(M)[t, k] ζ_{t,k} directions[k]."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, fail
from perfcontrol._linalg import Matrix, as_dense, times, times_transposed
from perfcontrol.perturbations.base import AbstractPerturbation, CovarianceOperator, Draws, varying, zero_mean
from perfcontrol.perturbations.dependence import as_scale, check_values
from perfcontrol.perturbations.scalar_laws import SCALAR_LAWS
from perfcontrol.policy_maps import AbstractPolicyMap, as_policy_map, evaluate_map


class _DirectionalDraws(Draws):
    mean: Array | None  # (n, p) or (T, n, p)
    coefficients: Array  # (T, k)
    directions: Array  # (k, n, p)
    side_by_side: ClassVar[bool] = True

    @property
    def steps(self) -> Any:
        return varying(self.mean), self.coefficients

    def matvec_step(self, step: Any, z: Array) -> Array:
        mean, coefficients = step
        mean = self.mean if mean is None else mean
        products = times(self._stack, z).reshape(len(coefficients), -1, *z.shape[1:])
        product = jnp.sum(coefficients[:, None] * products, axis=0)
        return product if mean is None else product + times(mean, z)

    def rmatvec_step(self, step: Any, y: Array) -> Array:
        mean, coefficients = step
        mean = self.mean if mean is None else mean
        product = times_transposed(self._stack, (coefficients[:, None] * y).reshape(-1, *y.shape[1:]))
        return product if mean is None else product + times_transposed(mean, y)

    @property
    def _stack(self) -> Array:
        """The directions one below the other, (k n, p)."""
        return self.directions.reshape(-1, *self.directions.shape[2:])

    def dense(self) -> Array:
        matrices = jnp.einsum("tk,knp->tnp", self.coefficients, self.directions)
        return matrices if self.mean is None else matrices + self.mean


class DirectionalCovariance(CovarianceOperator):
    """Σ_k variances[t, k] D_k X D_kᵀ and its adjoint."""

    variances: Array  # (T, k)
    directions: Array  # (k, n, p)

    @property
    def steps(self) -> Any:
        return self.variances

    def apply_step(self, step: Any, X: Array) -> Array:
        return jnp.einsum("k,kab,bc,kdc->ad", step, self.directions, X, self.directions, optimize="optimal")

    def adjoint_step(self, step: Any, X: Array) -> Array:
        return jnp.einsum("k,kba,bc,kcd->ad", step, self.directions, X, self.directions, optimize="optimal")

    def backward(self, F: Matrix) -> tuple[Any, Callable[[Any, Array], Array]]:
        # F beside the directions: two products a step, however many directions; all transposing is done here, once.
        stack = jnp.concatenate([as_dense(F)[None], self.directions])
        count, n, _ = stack.shape
        wide, tall = stack.transpose(1, 0, 2).reshape(n, count * n), stack.reshape(count * n, n).T

        def step_back(weights: Any, X: Array) -> Array:
            products = (X @ wide).reshape(n, count, n) * weights[:, None]
            return tall @ products.transpose(1, 0, 2).reshape(count * n, n)

        return jnp.pad(self.variances, ((0, 0), (1, 0)), constant_values=1), step_back


class DirectionalPerturbation(AbstractPerturbation):
    """Fixed directions with random coefficients whose size depends on the policy.

    Δ_t = mean(M)[t] + Σ_k scale(M)[t, k] ζ_{t,k} directions[k], ζ independent, of zero mean and unit variance.

    Args:
        directions: (k, n, n), or (k, n, n+m) to act on [x; u] (performative B).
        scale: policy map, callable or array with values (T, k) or (k,): standard deviations, up to sign. The laws of ζ
            are symmetric, so that only scale² matters: a map may change sign from policy to policy (an `Affine` one
            does somewhere), but a constant below zero is refused.
        mean: policy map, callable or array with values (T, n, p) or (n, p); None is zero.
        law: of ζ: "rademacher", "uniform" or "truncated_gaussian" (cut at three standard deviations).

    Raises:
        InputError: unknown law, a negative constant scale, or shapes that do not fit (when the problem is built).
    """

    directions: Array
    scale: AbstractPolicyMap
    mean_map: AbstractPolicyMap | None
    law: str = eqx.field(static=True)

    def __init__(self, directions: Any, scale: Any, mean: Any = None, law: str = "rademacher"):
        self.directions = as_array("directions", directions)
        if self.directions.ndim != 3:
            raise fail(
                "directions",
                f"{self.directions.shape}",
                "have shape (k, n, n) or (k, n, n+m)",
                "Pass a single direction D as [D].",
            )
        if law not in SCALAR_LAWS:
            raise fail("law", repr(law), f"be one of {sorted(SCALAR_LAWS)}", "Pass one of these names.")
        self.scale = as_scale("scale", scale)
        self.mean_map = None if mean is None else as_policy_map("mean", mean)
        self.law = law

    def columns(self, state_size: int, input_size: int) -> int:
        return self.directions.shape[-1]

    def check(self, policy_shape: tuple[int, int, int], horizon: int) -> None:
        _, m, n = policy_shape
        count, rows, columns = self.directions.shape
        if rows != n or columns not in (n, n + m):
            raise fail(
                "directions",
                f"{self.directions.shape}",
                f"have shape (k, n, n) = ({count}, {n}, {n}) or (k, n, n+m) = ({count}, {n}, {n + m})",
                "Pass matrices of that size: n and m come from the system.",
            )
        dtype = self.directions.dtype
        check_values("scale", self.scale, policy_shape, [(horizon, count), (count,)], dtype)
        if self.mean_map is not None:
            check_values("mean", self.mean_map, policy_shape, [(horizon, n, columns), (n, columns)], dtype)

    def scales(self, M: Array, horizon: int) -> Array:
        """scale(M), shape (T, k)."""
        return jnp.broadcast_to(evaluate_map(self.scale, M, "scale"), (horizon, self.directions.shape[0]))

    def sample(self, key: Key[Array, ""], M: Array, horizon: int) -> Draws:
        scales = self.scales(M, horizon)
        signs = SCALAR_LAWS[self.law].sample(key, scales.shape, scales.dtype)
        mean = None if self.mean_map is None else evaluate_map(self.mean_map, M, "mean")
        return _DirectionalDraws(mean, scales * signs, self.directions)

    def mean(self, M: Array, horizon: int) -> Array:
        if self.mean_map is None:
            return zero_mean(M, horizon, self.directions.shape[-1])
        return jnp.broadcast_to(evaluate_map(self.mean_map, M, "mean"), (horizon, *self.directions.shape[1:]))

    def mean_operator(self, M: Array, horizon: int) -> Array | None:
        return None if self.mean_map is None else self.mean(M, horizon)

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        return DirectionalCovariance(self.scales(M, horizon) ** 2, self.directions)

    def policy_free_mean(self, feasible_set: Any) -> bool:
        return self.mean_map is None or self.mean_map.constant

    def mean_derivative(self) -> Array | None:
        return None if self.mean_map is None else self.mean_map.derivative()

    def bound(self, feasible_set: Any, horizon: int) -> Array | None:
        """Σ_k sup|scale_k| sup|ζ| ‖D_k‖ + sup‖mean‖; known where the maps know their range."""
        scales = self.scale.largest(feasible_set)
        means = 0.0 if self.mean_map is None else self.mean_map.matrix_bound(feasible_set)
        if scales is None or means is None:
            return None
        norms = jnp.linalg.norm(self.directions, ord=2, axis=(-2, -1))
        total = SCALAR_LAWS[self.law].bound * jnp.sum(scales * norms, axis=-1) + means
        return jnp.broadcast_to(total, (horizon,))

    def sensitivity(self, feasible_set: Any, horizon: int) -> Array | None:
        """Σ_k L_k E|ζ| ‖D_k‖ + L: couples both laws by the same ζ; L_k, L Lipschitz constants of scales and mean."""
        by_scale = self.scale.lipschitz(feasible_set)
        by_mean = 0.0 if self.mean_map is None else self.mean_map.matrix_lipschitz(feasible_set)
        if by_scale is None or by_mean is None:
            return None
        norms = jnp.linalg.norm(self.directions, ord=2, axis=(-2, -1))
        total = SCALAR_LAWS[self.law].mean_absolute * jnp.sum(by_scale * norms, axis=-1) + by_mean
        return jnp.broadcast_to(total, (horizon,))
