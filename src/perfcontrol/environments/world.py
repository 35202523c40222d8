"""An episode of the plant, step by step and for any number of copies: pure functions, compiled once a problem."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._linalg import along_time, as_dense
from perfcontrol._programs import Numbers, program
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.rollout import draw_path, sample_path
from perfcontrol.perturbations import DirectionalPerturbation
from perfcontrol.policy_maps import Norm
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import Gaussian
from perfcontrol.systems import LinearSystem


class Episode(eqx.Module):
    """t, x_t (n,), the last w_{t-1}, ..., w_{t-H} (H, n), and what is to come: w (T, n) and Δ (T, n, p).

    Of several copies with a leading axis.
    """

    t: Numbers
    x: Numbers
    memory: Numbers
    w: Numbers
    matrices: Numbers


def example() -> PerformativeProblem:
    """Two states; the harder the policy acts, the more the world scatters."""
    return PerformativeProblem(
        system=LinearSystem([[0.9, 0.2], [0.0, 0.8]], np.eye(2)),
        horizon=20,
        noise=Gaussian(np.zeros(2), np.eye(2)),
        cost=QuadraticCost(np.eye(2), 0.1 * np.eye(2)),
        perturbation=DirectionalPerturbation([np.eye(2)], Norm([0.1], [0.2])),
    )


@program
def begin(problem: PerformativeProblem, deployed: Array, keys: Array) -> Episode:
    """The first states of the copies, one key and one deployed policy each."""

    def one(M: Array, key: Array) -> Episode:
        x0, w, draws = draw_path(problem, problem.structure.lift(M), key)
        memory = jnp.zeros((problem.memory, problem.state_size), w.dtype)
        return Episode(jnp.zeros((), int), x0, memory, w, draws.dense())

    return jax.vmap(one)(deployed, keys)


@program
def advance(problem: PerformativeProblem, episode: Episode, u: Array) -> tuple[Episode, Array, Array]:
    """The copies after a step with inputs u (N, m); the costs of that stage (N,), and [A_t, B_t] with Δ_t (N, n, n+m).

    At t = T only the cost is new.
    """
    T = problem.horizon
    system = [along_time(as_dense(matrix), 2, T) for matrix in (problem.system.A, problem.system.B)]
    fixed = jnp.concatenate(system, axis=2)

    def one(e: Episode, u: Array) -> tuple[Episode, Array, Array]:
        z, last = jnp.concatenate([e.x, u]), jnp.minimum(e.t, T - 1)
        matrix = fixed[last].at[:, : e.matrices.shape[2]].add(e.matrices[last])
        x, u_path = jnp.zeros((T + 1, len(e.x)), z.dtype), jnp.zeros((T + 1, len(u)), z.dtype)
        cost = problem.cost.path_cost(x.at[e.t].set(e.x), u_path.at[e.t].set(u))[e.t]
        following = matrix @ z + e.w[last]
        memory = jnp.concatenate([e.w[last][None], e.memory[:-1]])
        goes_on = e.t < T
        return (
            Episode(e.t + 1, jnp.where(goes_on, following, e.x), jnp.where(goes_on, memory, e.memory), e.w, e.matrices),
            cost,
            matrix,
        )

    return jax.vmap(one)(episode, u)


@program
def play(problem: PerformativeProblem, deployed: Array, keys: Array) -> Array:
    """The costs of one path of each policy in the world that it makes, (N,)."""

    def one(M: Array, key: Array) -> Array:
        policy = problem.structure.lift(M)
        path = sample_path(problem, policy, policy, key)
        return jnp.sum(problem.cost.path_cost(path.x, path.u))

    return jax.vmap(one)(deployed, keys)


@program
def project(problem: PerformativeProblem, M: Array) -> Array:
    """The nearest feasible policy of each, (N, *policy_shape)."""
    return jax.vmap(problem.feasible_set.project)(M)
