"""What a fit found: estimates with standard errors, what stayed unknown, and the problem that it makes."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import check_integer, check_key, fail
from perfcontrol.evaluate import Estimate
from perfcontrol.identification.covariance import semidefinite
from perfcontrol.identification.estimate import Moments
from perfcontrol.identification.features import Features
from perfcontrol.identification.location import jacobian
from perfcontrol.identification.logs import Logs
from perfcontrol.identification.plant import Coefficients, build, logged_start
from perfcontrol.identification.report import paragraph, table
from perfcontrol.identification.transitions import Transitions
from perfcontrol.identification.unidentified import gaps
from perfcontrol.problem import PerformativeProblem


@dataclass(frozen=True, eq=False)
class Fit:
    """A plant identified from logs. Built by `pc.fit`.

    `A` is the mean of the state matrix at M = 0 (where A + Θ(M) is A), the reaction of the mean is counted from there.

    Attributes:
        directions: D_k, (k, n, p).
        mean_features: what the reaction of the mean follows, `.name` in words.
        scale_features: what the reaction of the scale follows.
    """

    logs: Logs
    data: Transitions
    gain: np.ndarray
    directions: np.ndarray
    mean_features: Features
    scale_features: Features
    moments: Moments

    @property
    def A(self) -> Estimate:
        """State matrix, (n, n); the standard error is infinite where the logs do not tell."""
        n, m = self._sizes
        at_zero = self._at_zero()
        return self._estimate(at_zero[:n] + self.data.gain.T @ at_zero[n : n + m])

    @property
    def B(self) -> Estimate:
        """Input matrix, (n, m); the standard error is infinite where the logs do not tell."""
        n, m = self._sizes
        return self._estimate(self._at_zero()[n : n + m])

    @property
    def noise_mean(self) -> Estimate:
        """E w_t, (n,)."""
        estimate = self._estimate(self._at_zero()[-1:])
        return Estimate(estimate.mean[:, 0], estimate.standard_error[:, 0])

    @property
    def noise_covariance(self) -> Estimate:
        """Cov w_t, (n, n)."""
        n, _ = self._sizes
        rows, columns = np.triu_indices(n)
        errors = np.zeros((n, n))
        errors[rows, columns] = errors[columns, rows] = self.moments.covariance.standard_errors()[: len(rows)]
        return Estimate(jnp.asarray(self.moments.spread.noise), jnp.asarray(errors))

    @property
    def scale(self) -> Estimate:
        """Coefficients of the scales, (k, 1+q): scale_k(M) = c_k0 + Σ_j c_kj f_j(M). The sign of a row is arbitrary."""
        scales = self.moments.spread.scales
        errors = self.moments.covariance.standard_errors()
        errors = errors[len(errors) - scales.size :]
        return Estimate(jnp.asarray(scales), jnp.asarray(errors.reshape(scales.shape)))

    @property
    def deployed_scale(self) -> Estimate:
        """scale(M) at each deployed policy, (G, k)."""
        values = self.scale_features.values(self.data.policies)
        k, q = self.moments.spread.scales.shape
        covariance = (
            self.moments.covariance.covariance()[-k * q :, -k * q :].reshape(k, q, k, q) if k else np.zeros(4 * (0,))
        )
        variance = np.einsum("gq,kqkr,gr->gk", values, covariance, values) if k else np.zeros((len(values), 0))
        return Estimate(
            jnp.asarray(values @ self.moments.spread.scales.T), jnp.asarray(np.sqrt(np.maximum(variance, 0)))
        )

    @property
    def mean_reaction(self) -> Estimate:
        """Coefficients of Θ, (q, n, p): Θ(M) = Σ_j c_j (f_j(M) - f_j(0))."""
        n, _ = self._sizes
        width = self.directions.shape[2] if len(self.directions) else n
        count = self.mean_features.values(np.zeros((1, *self.data.policies.shape[1:]))).shape[1] - 1
        parts = [self._estimate(self._reaction(j, width)) for j in range(count)]
        if not parts:
            return Estimate(jnp.zeros((0, n, width)), jnp.zeros((0, n, width)))
        return Estimate(jnp.stack([p.mean for p in parts]), jnp.stack([p.standard_error for p in parts]))

    @property
    def unidentified(self) -> tuple[str, ...]:
        """What these logs leave open, in words; empty if nothing."""
        return tuple(gap.text for gap in self._gaps())

    def table(self) -> Any:
        """An xarray Dataset of the parameters: estimate, standard error and 95 % interval along its axis `value`."""
        return table(self)

    def __str__(self) -> str:
        return paragraph(self)

    @property
    def _sizes(self) -> tuple[int, int]:
        return self.data.x.shape[1], self.data.v.shape[1]

    def _gaps(self) -> Any:
        return gaps(self.data, self.moments.location, self.mean_features, self.scale_features)

    def _at_zero(self) -> np.ndarray:
        """The local mean coefficients (q rows) at M = 0 as functionals of the coefficients, (q, p)."""
        zero = self.mean_features.values(np.zeros((1, *self.data.policies.shape[1:])))
        n, m = self._sizes
        width = self.directions.shape[2] if len(self.directions) else n
        return jacobian(zero, np.arange(n + m + 1) < width)[0]

    def _reaction(self, feature: int, width: int) -> np.ndarray:
        """Θ's coefficients of one feature as functionals, (width, p); in x and u, not x and v."""
        n, m = self._sizes
        first = n + m + 1 + feature * width
        functional = np.zeros((width, self.moments.location.coefficients.shape[1]))
        functional[:, first : first + width] = np.eye(width)
        if width > n:
            functional[:n] += self.data.gain.T @ functional[n:]
        return functional

    def _estimate(self, functional: np.ndarray) -> Estimate:
        """functional (r, p) applied to each row of the coefficients: (n, r)."""
        location = self.moments.location
        n, free = location.coefficients.shape[0], location.identified.shape[1]
        covariance = self.moments.mean.covariance().reshape(n, free, n, free)
        through = functional @ location.identified
        variance = np.einsum("ra,iaib,rb->ir", through, covariance, through)
        hidden = np.abs(functional @ location.unidentified) > 1e-6 * np.linalg.norm(location.unidentified, axis=0)
        errors = np.where(hidden.any(axis=1), np.inf, np.sqrt(np.maximum(variance, 0)))
        return Estimate(jnp.asarray(location.coefficients @ functional.T), jnp.asarray(errors))

    def problem(
        self,
        *,
        cost: Any,
        horizon: int,
        feasible_set: Any = None,
        initial_state: Any = None,
        structure: Any = None,
        law: str = "rademacher",
    ) -> PerformativeProblem:
        """The fitted plant as a problem.

        Args:
            cost: as `pc.PerformativeProblem` takes it.
            horizon: likewise.
            feasible_set: likewise.
            initial_state: its law; None for mean and covariance of the logged first states.
            structure: as `pc.PerformativeProblem` takes it.
            law: of the random multiples of the directions. Costs of quadratic stages do not depend on it.

        Raises:
            InputError: A or B are not identified (see `unidentified`), or what does not fit the plant.
        """
        location, spread = self.moments.location, self.moments.spread
        coefficients = self._coefficients(location.coefficients, spread.noise, spread.scales)
        return self._build(
            coefficients,
            cost=cost,
            horizon=horizon,
            feasible_set=feasible_set,
            initial_state=initial_state,
            structure=structure,
            law=law,
        )

    def ensemble(
        self,
        k: int,
        *,
        key: Any = None,
        cost: Any,
        horizon: int,
        feasible_set: Any = None,
        initial_state: Any = None,
        structure: Any = None,
        law: str = "rademacher",
    ) -> PerformativeProblem:
        """k fitted plants from resampled episodes, as one stacked problem (a leading axis on every array).

        Episodes are drawn with replacement within each deployment, and the estimate takes one scoring step with the
        weights of the draw. Features and directions stay those of the fit. Use it as
        `jax.vmap(lambda p: pc.solve(p, pc.StablePoint(), throw=False))(ensemble)`.

        Args:
            k: how many.
            key: JAX random key.
            cost: as `problem` takes it, and all that follow.
            horizon: likewise.
            feasible_set: likewise.
            initial_state: likewise.
            structure: likewise.
            law: likewise.
        """
        weights = self._weights(check_integer("k", k, 1), check_key(key))
        n, _ = self._sizes
        location, noise = self.moments.location, n * (n + 1) // 2
        free = self.moments.mean.resampled(weights).reshape(k, n, -1)
        spread = self.moments.covariance.resampled(weights)
        members = [
            self._coefficients(
                location.coefficients + (draw - self.moments.mean.values.reshape(n, -1)) @ location.identified.T,
                semidefinite(values[:noise], n),
                values[noise:].reshape(self.moments.spread.scales.shape),
            )
            for draw, values in zip(free, spread, strict=True)
        ]
        stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, float) for leaf in leaves]), *members)
        return eqx.filter_vmap(
            lambda member: self._build(
                member,
                cost=cost,
                horizon=horizon,
                feasible_set=feasible_set,
                initial_state=initial_state,
                structure=structure,
                law=law,
            )
        )(stacked)

    def _weights(self, k: int, key: Any) -> np.ndarray:
        """How often each unit is drawn, (k, U): with replacement, within its deployment."""
        generator = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())
        weights = np.zeros((k, len(self.data.group)))
        for g in np.unique(self.data.group):
            members = np.flatnonzero(self.data.group == g)
            weights[:, members] = generator.multinomial(len(members), np.full(len(members), 1 / len(members)), size=k)
        return weights

    def _coefficients(self, location: np.ndarray, noise: np.ndarray, scales: np.ndarray) -> Coefficients:
        n, m = self._sizes
        local = location @ self._at_zero().T
        B = local[:, n : n + m]
        width = self.directions.shape[2] if len(self.directions) else n
        zero = self.mean_features.values(np.zeros((1, *self.data.policies.shape[1:])))[0, 1:]
        slopes = [location @ self._reaction(j, width).T for j in range(len(zero))]
        offset = -sum((f * slope for f, slope in zip(zero, slopes, strict=True)), np.zeros((n, width)))
        mean = np.stack([offset, *slopes], axis=-1)
        return Coefficients(local[:, :n] + B @ self.data.gain, B, local[:, -1], noise, mean, scales)

    def _build(self, c: Coefficients, **world: Any) -> PerformativeProblem:
        blocking = [gap.text for gap in self._gaps() if gap.blocks]
        if blocking:
            raise fail("logs", "; ".join(blocking), "identify A and B", "Log episodes that move what stood still.")
        if world["initial_state"] is None:
            world["initial_state"] = logged_start(self.logs)
        features = self.mean_features, self.scale_features
        return build(c, self.directions, *features, gain=self.gain, memory=self.data.policies.shape[1], **world)
