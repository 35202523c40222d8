"""Small problems whose every path can be enumerated, for the package and for the NumPy oracles alike."""

import functools
import itertools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc
from perfcontrol.perturbations.base import CovarianceOperator, Draws
from tests.oracles.enumeration import enumerate_cost
from tests.tools import normal, random_psd


class FiniteNoise(pc.AbstractRandomVector):
    """Finitely many atoms (T, k, n) of equal probability at each time: mean and covariance vary in time."""

    atoms: jax.Array

    @property
    def mean(self):
        return jnp.mean(self.atoms, axis=1)

    @property
    def covariance(self):
        centred = self.atoms - self.mean[:, None]
        return jnp.einsum("tka,tkb->tab", centred, centred) / self.atoms.shape[1]

    @property
    def bound(self):
        return jnp.max(jnp.linalg.norm(self.atoms, axis=-1))

    def sample(self, key, horizon):
        chosen = jax.random.randint(key, (horizon,), 0, self.atoms.shape[1])
        return jax.vmap(lambda atoms, index: atoms[index])(self.atoms[:horizon], chosen)


class DenseDraws(Draws):
    matrices: jax.Array

    @property
    def steps(self):
        return self.matrices

    def matvec_step(self, step, z):
        return step @ z

    def rmatvec_step(self, step, y):
        return step.T @ y

    def dense(self):
        return self.matrices


class DenseCovariance(CovarianceOperator):
    centred: jax.Array  # (T, k, n, p)
    probabilities: jax.Array  # (k,)

    @property
    def steps(self):
        return self.centred

    def apply_step(self, step, X):
        return jnp.einsum("k,kab,bc,kdc->ad", self.probabilities, step, X, step)

    def adjoint_step(self, step, X):
        return jnp.einsum("k,kba,bc,kcd->ad", self.probabilities, step, X, step)


class ReweightedMatrices(pc.AbstractPerturbation):
    """Matrices (T, 2, n, p) drawn with probabilities that depend on the policy, not on a scale."""

    values: jax.Array

    def probabilities(self, M):
        p = jax.nn.sigmoid(jnp.sum(M))
        return jnp.stack([p, 1 - p])

    def sample(self, key, M, horizon):
        first = jax.random.uniform(key, (horizon,), M.dtype) < self.probabilities(M)[0]
        return DenseDraws(jnp.where(first[:, None, None], self.values[:, 0], self.values[:, 1]))

    def mean(self, M, horizon):
        return jnp.einsum("k,tkab->tab", self.probabilities(M), self.values)

    def covariance(self, M, horizon):
        return DenseCovariance(self.values - self.mean(M, horizon)[:, None], self.probabilities(M))

    def bound(self, feasible_set, horizon):
        return None

    def sensitivity(self, feasible_set, horizon):
        return None

    def columns(self, state_size, input_size):
        return self.values.shape[-1]


class SmoothCost(pc.AbstractCost):
    """A convex cost that is not quadratic."""

    def path_cost(self, x, u):
        return jnp.sum(jnp.logaddexp(x, -x), axis=-1) + jnp.sum(jnp.sqrt(1 + u**2), axis=-1)

    def path_gradients(self, x, u):
        return jnp.tanh(x), u / jnp.sqrt(1 + u**2)

    def check(self, state_size, input_size, horizon):
        pass


@dataclass(frozen=True)
class Case:
    """A problem, two policies in its free parameters, and the finite laws that the oracles enumerate."""

    problem: pc.PerformativeProblem
    M: jax.Array
    deployed: jax.Array
    noise: list
    perturbations: list
    initial: tuple

    def system(self) -> dict:
        """Time-varying matrices for the oracles."""
        p = self.problem
        T, n, m = p.horizon, p.state_size, p.input_size
        return {
            "A": np.broadcast_to(p.system.A, (T, n, n)),
            "B": np.broadcast_to(p.system.B, (T, n, m)),
            "K": np.broadcast_to(p.gain, (T + 1, m, n)),
        }

    def cost(self) -> dict:
        """Time-varying cost for the oracles."""
        c, p = self.problem.cost, self.problem
        length, n, m = p.horizon + 1, p.state_size, p.input_size
        shapes = {"Q": (n, n), "R": (m, m), "cross": (n, m), "state_target": (n,), "input_target": (m,)}
        arrays = {name: getattr(c, name) for name in shapes}
        return {k: None if v is None else np.broadcast_to(v, (length, *shapes[k])) for k, v in arrays.items()}

    def laws(self) -> dict:
        return {"noise": self.noise, "perturbations": self.perturbations, "initial": self.initial}

    def enumerated(self, M=None) -> tuple[float, np.ndarray]:
        """Cost and gradient in the free parameters over every path, the world reacting to `deployed`."""
        lifted = np.asarray(self.problem.structure.lift(self.M if M is None else jnp.asarray(M)))
        cost, gradient = enumerate_cost(**self.system(), **self.cost(), M=lifted, **self.laws())
        return cost, np.asarray(self.problem.structure.adjoint(jnp.asarray(gradient)))


def uniform_law(atoms) -> tuple:
    atoms = np.asarray(atoms)
    return atoms, np.full(len(atoms), 1 / len(atoms))


def sign_law(centre, columns) -> tuple:
    """centre + Σ_k ±columns[k], every combination of signs."""
    centre, columns = np.asarray(centre), np.asarray(columns)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(columns))))
    return uniform_law(centre + np.tensordot(signs, columns, axes=1))


def directional_laws(law: pc.DirectionalPerturbation, lifted, horizon: int) -> list:
    means, scales = np.asarray(law.mean(lifted, horizon)), np.asarray(law.scales(lifted, horizon))
    directions = np.asarray(law.directions)
    return [sign_law(means[t], scales[t][:, None, None] * directions) for t in range(horizon)]


def weights(seed: int, n: int, m: int, length: int | None, targets: bool) -> pc.QuadraticCost:
    """A quadratic cost with all its parts, constant or varying in time, or with Q and R alone."""
    lead = () if length is None else (length,)
    joint = random_psd(seed, n + m, *lead)
    parts = {"Q": joint[..., :n, :n], "R": joint[..., n:, n:]}
    if targets:
        parts |= {
            "cross": joint[..., :n, n:],
            "state_target": normal(seed + 1, *lead, n),
            "input_target": normal(seed + 2, *lead, m),
        }
    return pc.QuadraticCost(**parts)


def system(seed: int, n: int, m: int, T: int | None = None) -> pc.LinearSystem:
    lead = () if T is None else (T,)
    return pc.LinearSystem(0.5 * normal(seed, *lead, n, n), normal(seed + 1, *lead, n, m))


def policies(seed: int, *shape: int) -> tuple[jax.Array, jax.Array]:
    return 0.7 * normal(seed, *shape), 0.5 * normal(seed + 1, *shape)


def directional(seed: int, k: int, n: int, p: int, T: int, policy: tuple, mean: bool) -> pc.DirectionalPerturbation:
    """Scales and means that depend on the policy, different at every time."""
    scale = pc.Affine(0.5 + 0.1 * normal(seed, T, k), 0.3 * normal(seed + 1, T, k, *policy))
    drift = pc.Affine(0.2 * normal(seed + 2, T, n, p), 0.1 * normal(seed + 3, T, n, p, *policy)) if mean else None
    return pc.DirectionalPerturbation(0.5 * normal(seed + 4, k, n, p), scale, drift)


def _scalar() -> Case:
    T = 4
    law = directional(10, 1, 1, 1, T, (1, 1, 1), mean=True)
    M, deployed = policies(12, 1, 1, 1)
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.8]], [[1.5]]),
        horizon=T,
        noise=pc.Rademacher(0.7, mean=0.4),
        cost=weights(13, 1, 1, None, targets=True),
        gain=[[0.3]],
        perturbation=law,
        initial_state=pc.Rademacher(0.5, mean=2.0),
    )
    noise = [sign_law([0.4], [[0.7]])] * T
    return Case(problem, M, deployed, noise, directional_laws(law, deployed, T), sign_law([2.0], [[0.5]]))


def _zero_mean() -> Case:
    """The paper's setting: constant matrices, zero-mean noise and perturbations, a known initial state."""
    T, n, m, H = 4, 2, 1, 2
    law = directional(20, 2, n, n, T, (H, m, n), mean=False)
    M, deployed = policies(22, H, m, n)
    root = np.asarray(normal(23, n, n))
    problem = pc.PerformativeProblem(
        system=system(24, n, m),
        horizon=T,
        noise=pc.Linear(pc.Rademacher(1.0), root),
        cost=weights(25, n, m, None, targets=False),
        memory=H,
        gain=0.3 * normal(26, m, n),
        perturbation=law,
        initial_state=[1.0, -2.0],
    )
    return Case(
        problem,
        M,
        deployed,
        [sign_law(np.zeros(n), root.T)] * T,
        directional_laws(law, deployed, T),
        uniform_law([[1.0, -2.0]]),
    )


def _everything_varies(on_input: bool) -> Case:
    """Time-varying A, B, K, weights, targets and means; H = 3 reaches back before time 0 at most stages."""
    T, n, m, H = 4, 2, 2, 3
    law = directional(30, 2, n, n + m if on_input else n, T, (H, m, n), mean=True)
    M, deployed = policies(32, H, m, n)
    atoms = normal(33, T, 2, n)
    start = np.asarray(normal(34, 3, n))
    problem = pc.PerformativeProblem(
        system=system(35, n, m, T),
        horizon=T,
        noise=FiniteNoise(atoms),
        cost=weights(36, n, m, T + 1, targets=True),
        memory=H,
        gain=0.3 * normal(37, T + 1, m, n),
        perturbation=law,
        initial_state=pc.Empirical(start),
    )
    noise = [uniform_law(atoms[t]) for t in range(T)]
    return Case(problem, M, deployed, noise, directional_laws(law, deployed, T), uniform_law(start))


def _repeated_block() -> Case:
    T, n, m, H = 3, 4, 2, 2
    law = directional(40, 1, n, n, T, (H, m, n), mean=True)
    M, deployed = policies(42, H, m // 2, n // 2)
    structure = pc.RepeatedBlock(2)
    atoms = np.asarray(normal(43, 3, n))
    problem = pc.PerformativeProblem(
        system=system(44, n, m, T),
        horizon=T,
        noise=pc.Empirical(atoms),
        cost=weights(45, n, m, None, targets=True),
        memory=H,
        gain=0.2 * normal(46, m, n),
        perturbation=law,
        structure=structure,
    )
    perturbations = directional_laws(law, structure.lift(deployed), T)
    return Case(problem, M, deployed, [uniform_law(atoms)] * T, perturbations, uniform_law(np.zeros((1, n))))


def _recorded() -> Case:
    """A disturbance known in advance, through a matrix; no covariance at all but the perturbation's."""
    T, n, m, H = 4, 2, 1, 2
    law = directional(50, 1, n, n, T, (H, m, n), mean=False)
    M, deployed = policies(52, H, m, n)
    values, matrix = np.asarray(normal(53, T, 1)), np.asarray(normal(54, n, 1))
    problem = pc.PerformativeProblem(
        system=system(55, n, m),
        horizon=T,
        noise=pc.Linear(pc.Sequence(values), matrix, offset=0.1),
        cost=weights(56, n, m, None, targets=False),
        memory=H,
        perturbation=law,
    )
    noise = [uniform_law([0.1 + matrix @ values[t]]) for t in range(T)]
    return Case(problem, M, deployed, noise, directional_laws(law, deployed, T), uniform_law(np.zeros((1, n))))


def _reweighted() -> Case:
    """A law that is no directional family, acting on [x; u]."""
    T, n, m, H = 4, 2, 1, 1
    values = 0.5 * normal(60, T, 2, n, n + m)
    law = ReweightedMatrices(values)
    M, deployed = policies(62, H, m, n)
    problem = pc.PerformativeProblem(
        system=system(63, n, m),
        horizon=T,
        noise=pc.Rademacher([1.0, 0.5], mean=[0.2, 0.0]),
        cost=weights(64, n, m, T + 1, targets=False),
        gain=0.3 * normal(65, m, n),
        perturbation=law,
        initial_state=pc.Constant([1.0, 1.0]),
    )
    probabilities = np.asarray(law.probabilities(deployed))
    perturbations = [(np.asarray(values[t]), probabilities) for t in range(T)]
    noise = [sign_law([0.2, 0.0], np.diag([1.0, 0.5]))] * T
    return Case(problem, M, deployed, noise, perturbations, uniform_law(np.ones((1, n))))


def _nothing_reacts() -> Case:
    T, n, m, H = 3, 2, 2, 2
    M, deployed = policies(72, H, m, n)
    problem = pc.PerformativeProblem(
        system=system(73, n, m, T),
        horizon=T,
        noise=pc.Rademacher(1.0, mean=0.5),
        cost=weights(75, n, m, None, targets=False),
        memory=H,
        initial_state=pc.Rademacher([1.0, 0.0]),
    )
    noise = [sign_law([0.5, 0.5], np.eye(n))] * T
    perturbations = [uniform_law(np.zeros((1, n, n)))] * T
    return Case(problem, M, deployed, noise, perturbations, sign_law(np.zeros(n), np.diag([1.0, 0.0])))


BUILDERS = {
    "scalar with every mean": _scalar,
    "zero means": _zero_mean,
    "everything varies": functools.partial(_everything_varies, False),
    "everything varies, performative B": functools.partial(_everything_varies, True),
    "repeated block": _repeated_block,
    "recorded disturbance": _recorded,
    "reweighted matrices": _reweighted,
    "nothing reacts": _nothing_reacts,
}


@functools.cache
def case(name: str) -> Case:
    """One case of the table, built once."""
    return BUILDERS[name]()


def replaced(problem: pc.PerformativeProblem, **parts) -> pc.PerformativeProblem:
    """The problem with some parts exchanged, checked anew."""
    names = ("system", "horizon", "noise", "cost", "memory", "gain", "perturbation", "feasible_set", "initial_state")
    values = {name: getattr(problem, name) for name in (*names, "structure")}
    return pc.PerformativeProblem(**(values | parts))


def batched_gradient(problem: pc.PerformativeProblem, deployed: jax.Array):
    """M -> exact ∇_1 over a leading axis of M, compiled once a problem shape."""
    return lambda points: _batched_gradient(problem, points, deployed)


@eqx.filter_jit
def _batched_gradient(problem, points, deployed):
    from perfcontrol.evaluate.exact import exact_gradient

    return jax.vmap(lambda M: exact_gradient(problem, M, deployed))(points)


def affine_gradient(problem: pc.PerformativeProblem, deployed: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """g and H of the gradient g + H θ, read off at zero and at the unit policies."""
    size = int(np.prod(problem.policy_shape))
    points = jnp.concatenate([jnp.zeros((1, size)), jnp.eye(size)]).reshape(-1, *problem.policy_shape)
    values = np.asarray(batched_gradient(problem, deployed)(points)).reshape(size + 1, size)
    return values[0], (values[1:] - values[0]).T
