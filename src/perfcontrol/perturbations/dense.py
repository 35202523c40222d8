"""Location and scale of dense random matrices: Δ_t = mean(M)[t] + scale(M)[t] Z_t, entry by entry."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, check_instance, fail
from perfcontrol._side_by_side import side_by_side
from perfcontrol.perturbations import redrawn
from perfcontrol.perturbations.base import (
    AbstractPerturbation,
    CovarianceOperator,
    DenseDraws,
    Draws,
    PathDraws,
    varying,
    zero_mean,
)
from perfcontrol.perturbations.counted import Counted
from perfcontrol.perturbations.dependence import as_scale, check_values
from perfcontrol.perturbations.scalar_laws import SCALAR_LAWS
from perfcontrol.perturbations.white_draws import normal_draws, sphere_draws, sphere_numbers
from perfcontrol.policy_maps import AbstractPolicyMap, as_policy_map, evaluate_map
from perfcontrol.random_keys import is_fast
from perfcontrol.random_vectors import AbstractRandomVector

WHITE_LAWS = (*sorted(SCALAR_LAWS), "gaussian", "sphere")
BY_PRODUCTS = {"gaussian": normal_draws, "sphere": sphere_draws}  # what a path needs of them is cheap to draw


class _White(eqx.Module):
    """Z, (n, p): independent entries of a named law, one matrix on the sphere, or a random vector row by row."""

    law: AbstractRandomVector | None
    kind: str = eqx.field(static=True)
    shape: tuple[int, int] = eqx.field(static=True)
    dtype: Any = eqx.field(static=True)

    def __call__(self, key: Key[Array, ""]) -> Array:
        return self.many(key, 1)[0]

    def many(self, key: Key[Array, "*keys"], count: int) -> Array:
        """`count` of them, independent; for a scalar law also of several keys side by side."""
        shape = (count, *self.shape)
        if self.law is not None:
            return self.law.sample(key, count).reshape(shape)
        if self.kind not in BY_PRODUCTS:
            return SCALAR_LAWS[self.kind].sample(key, shape, self.dtype)
        Z = jax.random.normal(key, shape, self.dtype)
        if self.kind == "sphere":
            Z = Z * jnp.sqrt(math.prod(self.shape) / jnp.sum(Z**2, axis=(-2, -1), keepdims=True))
        return Z


class _WhiteCovariance(CovarianceOperator):
    """Entries uncorrelated: E[(S∘Z) X (S∘Z)ᵀ] = diag_i(Σ_a S_ia² X_aa)."""

    variances: Array  # (n, p), or (1, 1) for all entries alike; or (T, ...)
    times: Array  # (T, 0): carries the horizon
    shape: tuple[int, int] = eqx.field(static=True)  # n, p

    @property
    def steps(self) -> Any:
        return self.times, varying(self.variances)

    def _at(self, step: Any) -> Array:
        return self.variances if step[1] is None else step[1]

    def apply_step(self, step: Any, X: Array) -> Array:
        rows = jnp.sum(self._at(step) * jnp.diagonal(X), axis=1)
        return jnp.diag(jnp.broadcast_to(rows, self.shape[0]))

    def adjoint_step(self, step: Any, X: Array) -> Array:
        columns = jnp.sum(self._at(step) * jnp.diagonal(X)[:, None], axis=0)
        return jnp.diag(jnp.broadcast_to(columns, self.shape[1]))


class _ColouredCovariance(CovarianceOperator):
    """E[(S∘Z) X (S∘Z)ᵀ]_ij = Σ_ab S_ia S_jb Cov(Z_ia, Z_jb) X_ab about the mean of Z."""

    scales: Array  # (T, n, p)
    spread: Array  # (n, p, n, p)

    @property
    def steps(self) -> Any:
        return self.scales

    def apply_step(self, step: Any, X: Array) -> Array:
        return jnp.einsum("ia,jb,iajb,ab->ij", step, step, self.spread, X, optimize="optimal")

    def adjoint_step(self, step: Any, X: Array) -> Array:
        return jnp.einsum("ia,jb,iajb,ij->ab", step, step, self.spread, X, optimize="optimal")


class DensePerturbation(AbstractPerturbation):
    """Random matrices whose location and scale depend on the policy.

    Δ_t = mean(M)[t] + scale(M)[t] Z_t, the scale multiplying all entries or each its own; Z_t independent over time.
    For uncorrelated entries of unit variance and a common scale s: E[(sZ) X (sZ)ᵀ] = s² tr(X) I.

    Args:
        scale: policy map, callable or array with values (), (T,), (n, p) or (T, n, p). For a named law, which is
            symmetric, only its square matters: a map may change sign, a constant below zero is refused.
        mean: policy map, callable or array with values (n, p) or (T, n, p); None is zero.
        law: of Z: "rademacher", "uniform", "truncated_gaussian" or "gaussian" (independent entries of zero mean and
            unit variance, the last without bound), "sphere" (uniform on the Frobenius sphere of radius √(n p), also of
            unit variances), or any random vector of dimension n p, which fills Z row by row; then its mean and
            covariance count too. With one scale for all entries, costs and gradients by simulation draw no more than
            n + p + 2 numbers a step for "gaussian" and "sphere".
        on_input: whether Δ acts on [x; u], p = n+m, instead of x, p = n.

    Raises:
        InputError: unknown law, a negative constant scale, or shapes that do not fit (when the problem is built).
    """

    scale: AbstractPolicyMap
    mean_map: AbstractPolicyMap | None
    law: AbstractRandomVector | None
    kind: str = eqx.field(static=True)
    on_input: bool = eqx.field(static=True)

    def __init__(self, scale: Any, mean: Any = None, law: Any = "uniform", on_input: bool = False):
        self.scale = (as_policy_map if isinstance(law, AbstractRandomVector) else as_scale)("scale", scale)
        self.mean_map = None if mean is None else as_policy_map("mean", mean)
        if isinstance(law, AbstractRandomVector):
            self.law, self.kind = law, "vector"
            if law.mean.ndim != 1:
                required = "be the same at all times"
                raise fail("law", f"{type(law).__name__} of {law.mean.shape[0]} steps", required, "Use `mean` instead.")
        elif isinstance(law, type):
            check_instance("law", law, AbstractRandomVector, "pc.Gaussian(mean, covariance)")
        elif isinstance(law, str) and law in WHITE_LAWS:
            self.law, self.kind = None, law
        else:
            raise fail("law", repr(law), f"be a random vector or one of {WHITE_LAWS}", "Pass one of these.")
        self.on_input = bool(on_input)

    def columns(self, state_size: int, input_size: int) -> int:
        return state_size + input_size if self.on_input else state_size

    def check(self, policy_shape: tuple[int, int, int], horizon: int) -> None:
        _, m, n = policy_shape
        p = self.columns(n, m)
        dtype = jnp.result_type(float)
        check_values("scale", self.scale, policy_shape, [(), (horizon,), (n, p), (horizon, n, p)], dtype)
        if self.mean_map is not None:
            check_values("mean", self.mean_map, policy_shape, [(n, p), (horizon, n, p)], dtype)
        if self.law is not None and self.law.resize(n * p).size != n * p:
            raise fail(
                "law",
                f"dimension {self.law.size}",
                f"have dimension n p = {n * p}",
                f"Pass a law with one entry per entry of the {n} x {p} matrix; `on_input` decides p.",
            )

    def _shape(self, M: Array) -> tuple[int, int]:
        return M.shape[-1], self.columns(M.shape[-1], M.shape[-2])

    def scales(self, M: Array, horizon: int) -> Array:
        """scale(M) entry by entry, (T, n, p)."""
        return jnp.broadcast_to(self._values(M), (horizon, *self._shape(M)))

    def _values(self, M: Array) -> Array:
        """scale(M), with the axis T in front of two others where it varies."""
        values = as_array("scale", evaluate_map(self.scale, M, "scale"))
        return values[:, None, None] if values.ndim == 1 else values

    def _vector(self, M: Array) -> AbstractRandomVector:
        assert self.law is not None
        return self.law.resize(math.prod(self._shape(M)))

    def sample(self, key: Key[Array, ""], M: Array, horizon: int) -> Draws:
        values = self._values(M)
        white = _White(None if self.law is None else self._vector(M), self.kind, self._shape(M), values.dtype)
        location = None if self.mean_map is None else evaluate_map(self.mean_map, M, "mean")
        if self._is_redrawn(M, values, horizon):
            return redrawn.RedrawnDraws(key, jnp.arange(horizon), white, values, location)

        def matrices(key: Key[Array, "*paths"], values: Array, location: Array | None) -> Array:
            spread = values * white.many(key, horizon)
            return spread if location is None else spread + location

        draw = side_by_side(matrices) if self.kind in SCALAR_LAWS else matrices
        return DenseDraws(draw(key, values, location))

    def sample_along(self, key: Key[Array, ""], M: Array, horizon: int) -> PathDraws:
        values = as_array("scale", evaluate_map(self.scale, M, "scale"))
        if self.kind not in BY_PRODUCTS or values.ndim > 1:
            return self.sample(key, M, horizon)
        location = None if self.mean_map is None else evaluate_map(self.mean_map, M, "mean")
        return BY_PRODUCTS[self.kind](key, location, jnp.broadcast_to(values, (horizon,)), *self._shape(M))

    def counted(self, key: Key[Array, ""], M: Array, horizon: int) -> Counted | None:
        """What `sample_along` would draw, before it is drawn: entries of a common scale from a fast key.

        Signs and uniform entries; in single precision normal ones and the sphere, too.
        """
        values = as_array("scale", evaluate_map(self.scale, M, "scale"))
        by_products = self.kind in BY_PRODUCTS and values.dtype == jnp.float32
        if not (by_products or self.kind in ("rademacher", "uniform")) or values.ndim > 1 or not is_fast(key):
            return None
        location = None if self.mean_map is None else evaluate_map(self.mean_map, M, "mean")
        scale = jnp.broadcast_to(values, (horizon,))
        if not by_products:
            return Counted(key, scale, location, self.kind, each=self._is_redrawn(M, values, horizon))
        key, chi = sphere_numbers(key, scale, *self._shape(M)) if self.kind == "sphere" else (key, None)
        return Counted(key, scale, location, "normal", chi)

    def _is_redrawn(self, M: Array, values: Array, horizon: int) -> bool:
        """Whether matrices, alike at all times, are too many to be held."""
        alike = self.law is None or self.law.covariance.ndim == 2  # as one drawn alone is taken to be
        return alike and horizon * math.prod(self._shape(M)) * values.dtype.itemsize > redrawn.HELD

    def _location(self, M: Array, horizon: int) -> Array:
        if self.mean_map is None:
            return zero_mean(M, horizon, self._shape(M)[1])
        return jnp.broadcast_to(evaluate_map(self.mean_map, M, "mean"), (horizon, *self._shape(M)))

    def mean(self, M: Array, horizon: int) -> Array:
        location = self._location(M, horizon)
        if self.law is None:
            return location
        return location + self.scales(M, horizon) * self._vector(M).mean.reshape(self._shape(M))

    def mean_operator(self, M: Array, horizon: int) -> Array | None:
        return None if self.mean_map is None and self.law is None else self.mean(M, horizon)

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        values, shape = self._values(M), self._shape(M)
        if self.law is None:
            squares = (values[None, None] if values.ndim == 0 else values) ** 2
            return _WhiteCovariance(squares, jnp.zeros((horizon, 0), values.dtype), shape)
        scales = self.scales(M, horizon)
        return _ColouredCovariance(scales, self._vector(M).covariance.reshape(*shape, *shape))

    def policy_free_mean(self, feasible_set: Any) -> bool:
        return self._scale_keeps_mean and (self.mean_map is None or self.mean_map.constant)

    def mean_derivative(self) -> Array | None:
        return self.mean_map.derivative() if self.mean_map is not None and self._scale_keeps_mean else None

    @property
    def _scale_keeps_mean(self) -> bool:
        return self.law is None or self.scale.constant

    def bound(self, feasible_set: Any, horizon: int) -> Array | None:
        """sup ‖mean‖ + sup ‖scale Z‖_F; known where the maps know their range and the law is bounded."""
        n, p = self._set_shape(feasible_set)
        largest = self.scale.largest(feasible_set)
        means = 0.0 if self.mean_map is None else self.mean_map.matrix_bound(feasible_set)
        if largest is None or means is None:
            return None
        entrywise = jnp.broadcast_to(largest[..., None, None] if largest.ndim < 2 else largest, (horizon, n, p))
        if self.kind == "gaussian":
            return None
        if self.kind in SCALAR_LAWS:
            total = SCALAR_LAWS[self.kind].bound * jnp.sqrt(jnp.sum(entrywise**2, axis=(-2, -1)))
        else:
            norm = math.sqrt(n * p) if self.law is None else self.law.resize(n * p).bound
            if norm is None:
                return None
            total = norm * jnp.max(entrywise, axis=(-2, -1))
        return jnp.broadcast_to(total + means, (horizon,))

    def sensitivity(self, feasible_set: Any, horizon: int) -> Array | None:
        """L + √E‖S ∘ Z‖²_F, by coupling both laws through the same Z; L and S Lipschitz constants of mean and scale."""
        n, p = self._set_shape(feasible_set)
        second = jnp.ones((n, p))
        if self.law is not None:
            law = self.law.resize(n * p)
            second = (jnp.diagonal(law.covariance) + law.mean**2).reshape(n, p)
        by_scale = self.scale.lipschitz(feasible_set)
        if by_scale is not None and by_scale.ndim < 2:  # one scale for all entries
            by_scale = by_scale * jnp.sqrt(jnp.sum(second))
        else:
            by_scale = self.scale.matrix_lipschitz(feasible_set, jnp.sqrt(second))
        by_mean = 0.0 if self.mean_map is None else self.mean_map.matrix_lipschitz(feasible_set)
        return None if by_scale is None or by_mean is None else jnp.broadcast_to(by_scale + by_mean, (horizon,))

    def _set_shape(self, feasible_set: Any) -> tuple[int, int]:
        _, m, n = feasible_set.shape
        return n, self.columns(n, m)
