"""What a fit found: estimates with standard errors, what stayed unknown, and the problem that it makes."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import check_integer, check_key, fail
from perfcontrol.identification.decision import Decision, decide
from perfcontrol.identification.estimate import Estimated
from perfcontrol.identification.features import Features
from perfcontrol.identification.logs import Logs
from perfcontrol.identification.moments import symmetric_basis
from perfcontrol.identification.parameter import Parameter, parameter
from perfcontrol.identification.plant import Coefficients, build, logged_start
from perfcontrol.identification.readings import HIDDEN, MeanReading
from perfcontrol.identification.report import paragraph, table
from perfcontrol.identification.transitions import Transitions
from perfcontrol.identification.unidentified import Gap, gaps
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import Constant
from perfcontrol.solvers import AbstractSolver, StablePoint


@dataclass(frozen=True, eq=False)
class Fit:
    """A plant identified from logs. Built by `pc.fit`.

    `A` is the mean of the state matrix at M = 0: the reaction of the mean is counted from there. Estimates have
    `.mean`, `.standard_error` by the jackknife over episodes, its `.degrees_of_freedom` and `.interval(level=0.95)`.

    Attributes:
        mean_features: what the reaction of the mean follows, `.name` in words.
        scale_features: what the reaction of the scales follows.
    """

    logs: Logs
    data: Transitions
    gain: np.ndarray
    mean_features: Features
    scale_features: Features
    estimated: Estimated

    @property
    def A(self) -> Parameter:
        """State matrix, (n, n); the standard error is infinite where the logs do not tell."""
        return self._mean.estimate(self._mean.functionals()["A"])

    @property
    def B(self) -> Parameter:
        """Input matrix, (n, m); the standard error is infinite where the logs do not tell."""
        return self._mean.estimate(self._mean.functionals()["B"])

    @property
    def noise_mean(self) -> Parameter:
        """E w_t, (n,)."""
        return jax.tree.map(lambda column: column[:, 0], self._mean.estimate(self._mean.functionals()["noise_mean"]))

    @property
    def mean_reaction(self) -> Parameter:
        """Coefficients of Θ, (q, n, p): Θ(M) = Σ_j c_j (f_j(M) - f_j(0))."""
        parts = [self._mean.estimate(functional) for functional in self._mean.slopes()]
        if not parts:
            empty = jnp.zeros((0, self.logs.state_size, self._mean.width))
            return Parameter(empty, empty, empty)
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)

    @property
    def noise_covariance(self) -> Parameter:
        """Cov w_t, (n, n)."""
        spread, n = self.estimated.spread, self.logs.state_size
        size = n * (n + 1) // 2
        unknown = self._untold(np.eye(size, len(spread.block.values)))
        square = np.tensordot(np.arange(size), symmetric_basis(n), axes=1).astype(int)  # the place of each entry
        return parameter(spread.noise, spread.noise_influence()[:, square], unknown[square])

    @property
    def scale(self) -> Parameter:
        """Coefficients of the scales, (k, 1+q): scale_k(M) = c_k0 + Σ_j c_kj f_j(M). The sign of a row is arbitrary."""
        spread = self.estimated.spread
        untold = self._untold_scales(np.eye(spread.scales.shape[1])).T
        return parameter(spread.scales, spread.scale_influence(), untold)

    @property
    def deployed_scale(self) -> Parameter:
        """scale(M) at each deployed policy, (G, k)."""
        spread, values = self.estimated.spread, self.scale_features.values(self.data.policies)
        influence = np.einsum("gq,ukq->ugk", values, spread.scale_influence())
        return parameter(values @ spread.scales.T, influence, self._untold_scales(values))

    @property
    def directions(self) -> Parameter:
        """D_k, (k, n, p); the standard error is zero where they were given. The sign of each is arbitrary."""
        spread = self.estimated.spread
        return parameter(spread.directions, spread.direction_influence())

    @property
    def unidentified(self) -> tuple[str, ...]:
        """What these logs leave open, in words; empty if nothing."""
        return tuple(gap.text for gap in self._gaps())

    def table(self) -> Any:
        """An xarray Dataset of the parameters: estimate, standard error and 95 % interval along its axis `value`."""
        return table(self)

    def __str__(self) -> str:
        return paragraph(self)

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
            initial_state: its law; None for mean and covariance of the logged first states (resampled in `ensemble`).
            structure: as `pc.PerformativeProblem` takes it.
            law: of the random multiples of the directions. Costs of quadratic stages do not depend on it.

        Raises:
            InputError: A or B are not identified (see `unidentified`), or what does not fit the plant.
        """
        spread = self.estimated.spread
        once = np.ones(len(self.data.group))
        coefficients = self._coefficients(self.estimated.mean.values, spread.block.values, once)
        world = self._world(initial_state) | {"cost": cost, "horizon": horizon, "law": law}
        return build(coefficients, feasible_set=feasible_set, structure=structure, **world)

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
        weights of the draw. Features, and how many directions there are, stay those of the fit. Use it as
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
        resampled = (self.estimated.mean.resampled(weights), self.estimated.spread.block.resampled(weights))
        members = [self._coefficients(*draw) for draw in zip(*resampled, weights, strict=True)]
        stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, float) for leaf in leaves]), *members)
        world = self._world(initial_state) | {"cost": cost, "horizon": horizon, "law": law}
        return eqx.filter_vmap(lambda c: build(c, feasible_set=feasible_set, structure=structure, **world))(stacked)

    def decide(
        self,
        k: int = 200,
        *,
        key: Any = None,
        cost: Any,
        horizon: int,
        feasible_set: Any = None,
        initial_state: Any = None,
        structure: Any = None,
        law: str = "rademacher",
        solver: AbstractSolver = StablePoint(),
        certificate: Any = "sharp",
        level: float = 0.95,
    ) -> Decision:
        """The stable policy that these logs suggest, and how well they pin it down.

        `problem` and each member of `ensemble` are solved and certified. Intervals lie between quantiles of what the
        members say.

        Args:
            k: members of the ensemble; their quantiles need some hundred.
            key: JAX random key of the ensemble, and of the solver where that samples.
            cost: as `problem` takes it, and all that follow.
            horizon: likewise.
            feasible_set: likewise.
            initial_state: likewise.
            structure: likewise.
            law: likewise.
            solver: of the stable policy.
            certificate: a kind, as `pc.certify` takes it.
            level: of the intervals.

        Returns:
            A `Decision`: policy and costs with intervals, shares that are solved and certified; str() is a paragraph.

        Raises:
            InputError: as `problem` and `ensemble`; no member of the ensemble has a stable policy.
            SolveError: the solver finds no stable policy of the fitted problem.
        """
        world = dict(
            cost=cost,
            horizon=horizon,
            feasible_set=feasible_set,
            initial_state=initial_state,
            structure=structure,
            law=law,
        )
        ensemble = self.ensemble(k, key=key, **world)
        return decide(self.problem(**world), ensemble, solver, certificate, level, key)

    @property
    def _mean(self) -> MeanReading:
        zero = self.mean_features.values(np.zeros((1, *self.data.policies.shape[1:])))[0]
        width = self.estimated.spread.directions.shape[2]
        return MeanReading(self.estimated.location, self.estimated.mean, self.data.gain, zero, width)

    def _untold_scales(self, values: np.ndarray) -> np.ndarray:
        """Whether features (V, Q) times the coefficients of each scale are unknown, (V, k)."""
        n, (k, width) = self.logs.state_size, self.estimated.spread.scales.shape
        first, functional = n * (n + 1) // 2, np.zeros((len(values), k, len(self.estimated.spread.block.values)))
        for j in range(k):
            functional[:, j, first + j * width : first + (j + 1) * width] = values
        return self._untold(functional)

    def _untold(self, functional: np.ndarray) -> np.ndarray:
        """Whether functionals (..., P) of noise and scales feel what the logs do not tell."""
        hidden = self.estimated.hidden
        if not hidden.shape[1]:
            return np.zeros(functional.shape[:-1], dtype=bool)
        size = np.linalg.norm(hidden, axis=0)
        return np.any(np.abs(functional @ hidden) > HIDDEN * size, axis=-1)

    def _gaps(self) -> list[Gap]:
        return gaps(self.data, self.estimated, self.mean_features, self.scale_features)

    def _weights(self, k: int, key: Any) -> np.ndarray:
        """How often each unit is drawn, (k, U): with replacement, within its deployment."""
        generator = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())
        weights = np.zeros((k, len(self.data.group)))
        for g in np.unique(self.data.group):
            members = np.flatnonzero(self.data.group == g)
            weights[:, members] = generator.multinomial(len(members), np.full(len(members), 1 / len(members)), size=k)
        return weights

    def _coefficients(self, mean: np.ndarray, spread: np.ndarray, weights: np.ndarray) -> Coefficients:
        """The numbers of a plant from values of the two blocks, and weights of the units for the initial state."""
        coefficients = self._mean.coefficients(mean)
        read = {name: coefficients @ f.T for name, f in self._mean.functionals().items()}
        noise, scales, directions = self.estimated.spread.at(spread)
        reaction = self._mean.reaction(coefficients)
        start = logged_start(self._first_states, weights[self.data.first])
        return Coefficients(read["A"], read["B"], read["noise_mean"][:, 0], noise, reaction, scales, directions, *start)

    @property
    def _first_states(self) -> np.ndarray:
        return np.stack([x[0] for x in self.logs.x])

    def _world(self, initial_state: Any) -> dict[str, Any]:
        """What every plant of this fit shares."""
        blocking = [gap.text for gap in self._gaps() if gap.blocks]
        if blocking:
            raise fail("logs", "; ".join(blocking), "identify A and B", "Log episodes that move what stood still.")
        first = self._first_states
        if initial_state is None and np.ptp(first, axis=0).max() == 0:
            initial_state = Constant(first[0])
        return {
            "features": (self.mean_features, self.scale_features),
            "names": (self.logs.state_names, self.logs.input_names),
            "gain": self.gain if self.gain.ndim else float(self.gain),
            "memory": self.data.policies.shape[1],
            "initial_state": initial_state,
        }
