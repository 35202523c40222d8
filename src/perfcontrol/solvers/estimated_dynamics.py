"""A gradient from states, inputs and noise: the perturbations are estimated from the episodes that it uses."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import as_array, fail, is_concrete
from perfcontrol._linalg import along_time, as_dense
from perfcontrol.evaluate.adjoint import path_gradient
from perfcontrol.evaluate.paths import over_paths
from perfcontrol.evaluate.rollout import Path, input_term, sample_path
from perfcontrol.perturbations.base import DenseDraws
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers.gradients import AbstractGradient


class EstimatedDynamics(AbstractGradient):
    """The path gradient where A_t + Δ_t is not observed, as Algorithm 1 has it, but only x, u and the noise w are, on
    which the policy acts.

    Regresses x_{t+1} - A_t x_t - B_t u_t - w_t = Δ_t z_t on z_t (x_t, or [x_t; u_t]), with an intercept, over all steps
    of the `batch` episodes, takes the slope Θ̂ for every Δ_t, and goes back along each path as `pc.Pathwise` does.

    What is lost: (1) how Δ_t scatters around its mean: the cost-to-go lacks its part of 𝒞*, so that RSGD comes to rest
    elsewhere, the farther the larger that variance. (2) how EΔ_t varies in time. (3) the regression error where Δ_t
    scatters, of order n / (horizon · batch), severe for a single short episode. Where Δ_t neither scatters nor varies,
    nothing is. docs: "Which method when" has the measured bias.

    Args:
        ridge: added to the regression's normal matrix, relative to its mean eigenvalue, so that states that do not
            vary do no harm; not negative.

    Raises:
        InputError: a negative ridge.
    """

    ridge: Array

    def __init__(self, ridge: Any = 1e-6):
        self.ridge = as_array("ridge", ridge)
        if is_concrete(self.ridge) and not (self.ridge.ndim == 0 and float(self.ridge) >= 0):
            raise fail("ridge", str(self.ridge), "be a number that is not negative", "Leave it out for 1e-6.")

    def __call__(
        self, problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""], batch: int
    ) -> Array:
        policy, reacting = problem.structure.lift(M), problem.structure.lift(deployed)

        def observed(key: Array) -> tuple[Array, Array, Array]:
            path = sample_path(problem, policy, reacting, key)
            return path.x, path.u, path.w

        x, u, w = over_paths(problem, observed, key, batch)
        slope = _slope(*jax.vmap(lambda x, u, w: _moved(problem, x, u, w))(x, u, w), self.ridge)
        draws = DenseDraws(jnp.broadcast_to(slope, (problem.horizon, *slope.shape)))
        return jnp.mean(jax.vmap(lambda x, u, w: path_gradient(problem, Path(x, u, w, draws)))(x, u, w), axis=0)


def _moved(problem: PerformativeProblem, x: Array, u: Array, w: Array) -> tuple[Array, Array]:
    """z_t (T, p) and x_{t+1} - A_t x_t - B_t u_t - w_t (T, n) of one episode."""
    n, m = problem.state_size, problem.input_size
    z = jnp.concatenate([x, u], axis=1)[:-1, : problem.perturbation.columns(n, m)]
    A = along_time(as_dense(problem.system.A), 2, problem.horizon)
    return z, x[1:] - jnp.einsum("tij,tj->ti", A, x[:-1]) - input_term(problem.system.B, u) - w


def _slope(z: Array, response: Array, ridge: Array) -> Array:
    """Least squares of the responses on z with an intercept, over all episodes and steps: (n, p)."""
    z, response = z.reshape(-1, z.shape[-1]), response.reshape(-1, response.shape[-1])
    centred = z - jnp.mean(z, axis=0)
    normal = centred.T @ centred
    size = jnp.trace(normal) / len(normal)
    # Where nothing varies at all there is nothing to learn, and the slope is zero.
    shift = jnp.where(size > 0, ridge * size, 1).astype(normal.dtype)
    return jnp.linalg.solve(normal + shift * jnp.eye(len(normal), dtype=normal.dtype), centred.T @ response).T
