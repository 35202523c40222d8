"""One step of a running plant: the input that the policy asks for, the noise and the perturbation that came of it.

With A_t + Δ_t observed, w_t = x_{t+1} - (A_t + Δ_t) x_t - B_t u_t. Where it is not, Δ_t is taken to be what the model
expects, E Δ_t under the deployed policy: w_t then holds (Δ_t - E Δ_t) x_t, too.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._linalg import along_time, as_dense
from perfcontrol._programs import program
from perfcontrol.evaluate.rollout import Path, run_path
from perfcontrol.online.state import Episodes, Progress
from perfcontrol.perturbations.base import DenseDraws
from perfcontrol.policy import DisturbanceAction
from perfcontrol.problem import PerformativeProblem


def _law(problem: PerformativeProblem, M: Array) -> DisturbanceAction:
    return DisturbanceAction(problem.gain, problem.structure.lift(M))


@program
def act(problem: PerformativeProblem, deployed: Array, progress: Progress, x: Array) -> Array:
    """u_t."""
    return _law(problem, deployed).act(progress.memory, x, progress.t)


@program
def observe(
    problem: PerformativeProblem,
    deployed: Array,
    progress: Progress,
    x: Array,
    u: Array,
    x_next: Array,
    A: Array | None,
) -> Progress:
    """The progress after one step; A as `Controller.observe` takes it."""
    t, kept, T = progress.t, progress.kept, problem.horizon
    width = problem.perturbation.columns(problem.state_size, problem.input_size)
    system = [along_time(as_dense(matrix), 2, T)[t] for matrix in (problem.system.A, problem.system.B)]
    fixed = jnp.concatenate(system, axis=1)
    if A is None:
        mean = problem.perturbation.mean(problem.structure.lift(deployed), T)
        assert mean is not None
        matrix = mean[t]
    else:
        matrix = A - fixed[:, :width]
    z = jnp.concatenate([x, u])
    w = x_next - fixed @ z - matrix @ z[:width]
    episodes = progress.episodes
    following = Episodes(
        jnp.where(t == 0, episodes.x0.at[kept].set(x), episodes.x0),
        episodes.w.at[kept, t].set(w),
        episodes.matrices.at[kept, t].set(matrix),
    )
    memory = _law(problem, deployed).observe(progress.memory, w)
    return Progress(t + 1, kept, x_next, memory, following)


def replay(problem: PerformativeProblem, M: Array, episodes: Episodes) -> Path:
    """The paths that the policy M would have had in these episodes, with a leading axis."""
    policy = problem.structure.lift(M)

    def one(x0: Array, w: Array, matrices: Array) -> Path:
        return run_path(problem, policy, x0, w, DenseDraws(matrices))

    return jax.vmap(one)(episodes.x0, episodes.w, episodes.matrices)


@program
def costs(problem: PerformativeProblem, M: Array, episodes: Episodes) -> Array:
    """What the policy M would have cost in these episodes, (b,)."""
    paths = replay(problem, M, episodes)
    return jnp.sum(jax.vmap(problem.cost.path_cost)(paths.x, paths.u), axis=-1)
