"""Perturbations that take finitely many values: Δ_t = values[t, j] with probability probabilities(M)[t, j]."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, fail, is_concrete
from perfcontrol.perturbations.base import AbstractPerturbation, CovarianceOperator, Draws, MetDraws
from perfcontrol.perturbations.dependence import check_values
from perfcontrol.policy_maps import AbstractPolicyMap, ConstantMap, as_policy_map, evaluate_map


class _FiniteDraws(MetDraws):
    indices: Array  # (T,); past the end where the probabilities are invalid, which reads as NaN
    values: Array  # (k, n, p) or (T, k, n, p)

    @property
    def steps(self) -> Any:
        return self.indices, self.values if self.values.ndim == 4 else None

    def matrix(self, step: Any) -> Array:
        index, values = step
        return jnp.take(self.values if values is None else values, index, axis=0, mode="fill", fill_value=jnp.nan)


class _FiniteCovariance(CovarianceOperator):
    probabilities: Array  # (T, k)
    mean: Array  # (T, n, p)
    values: Array  # (k, n, p) or (T, k, n, p)

    @property
    def steps(self) -> Any:
        return self.probabilities, self.mean, self.values if self.values.ndim == 4 else None

    def _centred(self, step: Any) -> tuple[Array, Array]:
        probabilities, mean, values = step
        return probabilities, (self.values if values is None else values) - mean

    def apply_step(self, step: Any, X: Array) -> Array:
        return jnp.einsum("k,kab,bc,kdc->ad", *_spread(self._centred(step), X), optimize="optimal")

    def adjoint_step(self, step: Any, X: Array) -> Array:
        return jnp.einsum("k,kba,bc,kcd->ad", *_spread(self._centred(step), X), optimize="optimal")


def _spread(weighted: tuple[Array, Array], X: Array) -> tuple[Array, Array, Array, Array]:
    probabilities, deviations = weighted
    return probabilities, deviations, X, deviations


class FinitePerturbation(AbstractPerturbation):
    """Finitely many matrices whose probabilities depend on the policy.

    P(Δ_t = values[t, j]) = probabilities(M)[t, j].

    Args:
        values: (k, n, p), or (T, k, n, p) where they vary in time; p = n, or n+m to act on [x; u].
        probabilities: policy map, callable or array with values (T, k) or (k,): nonnegative, of sum one over j, for
            every feasible policy. Where a policy makes them anything else, draws and moments are NaN, which solvers
            report.

    Raises:
        InputError: constant probabilities that are no distribution, or shapes that do not fit (when the problem is
            built).
    """

    values: Array
    probabilities: AbstractPolicyMap

    def __init__(self, values: Any, probabilities: Any):
        self.values = as_array("values", values)
        if self.values.ndim not in (3, 4):
            required = "have shape (k, n, p) or (T, k, n, p)"
            raise fail("values", f"{self.values.shape}", required, "Pass a single matrix V as [V].")
        self.probabilities = as_policy_map("probabilities", probabilities)
        if not isinstance(self.probabilities, ConstantMap) or not is_concrete(constant := self.probabilities.value):
            return
        if constant.ndim == 0 or not bool(jnp.all(_is_distribution(constant))):
            got = f"least entry {float(jnp.min(constant)):.3g} and sums {jnp.sum(jnp.atleast_1d(constant), axis=-1)}"
            required = "be nonnegative with sum one over the values"
            raise fail("probabilities", got, required, "Divide them by their sum.")

    @property
    def _count(self) -> int:
        return self.values.shape[-3]

    def columns(self, state_size: int, input_size: int) -> int:
        return self.values.shape[-1]

    def check(self, policy_shape: tuple[int, int, int], horizon: int) -> None:
        _, m, n = policy_shape
        *time, k, rows, columns = self.values.shape
        if rows != n or columns not in (n, n + m) or time not in ([], [horizon]):
            raise fail(
                "values",
                f"{self.values.shape}",
                f"have shape (k, n, p) = ({k}, {n}, {n} or {n + m}), or ({horizon}, {k}, ...) where they vary in time",
                "Pass matrices of that size: n and m come from the system.",
            )
        check_values("probabilities", self.probabilities, policy_shape, [(horizon, k), (k,)], self.values.dtype)

    def distribution(self, M: Array, horizon: int) -> Array:
        """probabilities(M), (T, k); NaN at times where they are no distribution."""
        values = jnp.broadcast_to(evaluate_map(self.probabilities, M, "probabilities"), (horizon, self._count))
        return jnp.where(_is_distribution(values)[:, None], values, jnp.nan)

    def sample(self, key: Key[Array, ""], M: Array, horizon: int) -> Draws:
        # By inversion: one random number a step, and no value of probability zero, whatever the rounding.
        distribution = self.distribution(M, horizon)
        cumulative = jnp.cumsum(distribution, axis=-1)
        uniform = jax.random.uniform(key, (horizon, 1), distribution.dtype)
        indices = jnp.sum(uniform * cumulative[:, -1:] >= cumulative, axis=-1)
        return _FiniteDraws(jnp.where(jnp.isnan(cumulative[:, -1]), self._count, indices), self.values)

    def log_probability(self, draws: Draws, M: Array, horizon: int) -> Array:
        assert isinstance(draws, _FiniteDraws)
        chosen = jnp.take_along_axis(self.distribution(M, horizon), draws.indices[:, None], axis=1)
        return jnp.sum(jnp.log(chosen))

    def mean(self, M: Array, horizon: int) -> Array:
        time = "t" if self.values.ndim == 4 else ""
        return jnp.einsum(f"tk,{time}knp->tnp", self.distribution(M, horizon), self.values)

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        return _FiniteCovariance(self.distribution(M, horizon), self.mean(M, horizon), self.values)

    def policy_free_mean(self, feasible_set: Any) -> bool:
        return self.probabilities.constant

    def bound(self, feasible_set: Any, horizon: int) -> Array:
        """max_j ‖values[t, j]‖, whatever the policy."""
        norms = jnp.linalg.norm(self.values, ord=2, axis=(-2, -1))
        return jnp.broadcast_to(jnp.max(norms, axis=-1), (horizon,))

    def sensitivity(self, feasible_set: Any, horizon: int) -> Array | None:
        """Σ_j L_j min(½ diameter, ‖V_j - V̄‖ for all j): probability moved times the way; L_j the Lipschitz constants.

        Moving Σ_j |dp_j| / 2 at most the diameter, or all of it through the average V̄ of the values.
        """
        moved = self.probabilities.lipschitz(feasible_set)
        if moved is None:
            return None
        apart = self.values[..., :, None, :, :] - self.values[..., None, :, :, :]
        diameter = jnp.max(jnp.linalg.norm(apart, ord=2, axis=(-2, -1)), axis=(-2, -1))
        centre = jnp.mean(self.values, axis=-3, keepdims=True)
        distance = jnp.linalg.norm(self.values - centre, ord=2, axis=(-2, -1))
        directly = jnp.sum(moved, axis=-1) * diameter / 2
        return jnp.broadcast_to(jnp.minimum(directly, jnp.sum(moved * distance, axis=-1)), (horizon,))


def _is_distribution(values: Array) -> Array:
    """Whether rows are nonnegative with sum one, up to rounding."""
    slack = jnp.sqrt(jnp.finfo(values.dtype).eps)
    return jnp.all(values >= 0, axis=-1) & (jnp.abs(jnp.sum(values, axis=-1) - 1) <= slack)
