"""The gradient of one path's cost by M, in linear time: forward states, backward adjoints.

With y_t the adjoint of x_t and h_t = ∇_u c_t + B_tᵀ y_{t+1} (+ Δ's part on u):
    y_t = ∇_x c_t - K_tᵀ ∇_u c_t + (A_t + Δ_t - B_t K_t)ᵀ y_{t+1},   ∇_{M[i-1]} J = Σ_t h_t w_{t-i}ᵀ.
The same numbers as the paper's double sum (Appendix B, "grad M ct"), which costs O(T²); the terminal stage, which
Algorithm 1 leaves out of its own objective, is included.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from perfcontrol._checks import as_array, check_shape, fail
from perfcontrol._linalg import times, times_transposed, transpose
from perfcontrol._programs import program
from perfcontrol.evaluate.by_kernel import by_kernel
from perfcontrol.evaluate.paths import over_paths
from perfcontrol.evaluate.rollout import (
    Path,
    Trajectories,
    check_paths,
    input_adjoint,
    input_term,
    sample_along,
)
from perfcontrol.evaluate.time_loop import time_loop
from perfcontrol.policy import feedforward_adjoint
from perfcontrol.problem import PerformativeProblem, check_problem


def path_gradient(problem: PerformativeProblem, path: Path | Trajectories) -> Array:
    """∇_M of the cost of an observed path, summed over its stages, perturbations and noise held fixed.

    Args:
        problem: the problem.
        path: states, inputs, noise and perturbation operators of one path (`Trajectories` with a sample axis give
            the mean over samples).

    Returns:
        The gradient in the free parameters, shape `problem.policy_shape`.

    References:
        Appendix B, equation (grad M ct), with the window w_{t-1}, ..., w_{t-H}.
    """
    check_problem(problem)
    if not isinstance(path, Path | Trajectories):
        raise fail("path", type(path).__name__, "be simulated paths", "Pass what pc.simulate returns.")
    if not problem.is_finite:
        return path_gradient(problem.truncated(path.w.shape[-2]), path)
    if isinstance(path, Trajectories):

        def one(single: Trajectories) -> Array:
            return path_gradient(problem, Path(single.x, single.u, single.w, single.draws))

        return jnp.mean(jax.vmap(one)(path), axis=0)
    return problem.structure.adjoint(_by_policy(problem, path))


def _by_policy(problem: PerformativeProblem, path: Path) -> Array:
    """The gradient by the full policy."""
    system = problem.system
    n, m = problem.state_size, problem.input_size
    acts_on_input = problem.perturbation.columns(n, m) > n
    by_state, by_input = problem.cost.path_gradients(path.x, path.u)
    gains = problem.gains()
    source = by_state - problem.feedback_adjoint(by_input) if problem.has_gain else by_state
    loop = problem.closed_loop(system.A, system.B)
    varying = loop.ndim == 3

    def retreat(fixed: Any, y: Array, step: Any) -> tuple[Array, tuple[Array, Array | None]]:
        pulling, draws = fixed
        source_t, draw, loop_t, gain_t = step
        reaction = draws.rmatvec_step(draw, y)
        pulled = (times_transposed(loop_t, y) if varying else times(pulling, y)) + source_t
        if acts_on_input:
            return pulled + reaction[:n] - times_transposed(gain_t, reaction[n:]), (y, reaction[n:])
        return pulled + reaction, (y, None)

    met = jnp.concatenate([path.x, path.u], axis=1)[:-1] if acts_on_input else path.x[:-1]
    back = path.draws.steps_back(met)
    steps = (source[:-1], back, loop if varying else None, gains[:-1] if acts_on_input else None)
    fixed = None if varying else transpose(loop), path.draws
    following, on_input = time_loop(retreat, fixed, source[-1], steps, path.draws.side_by_side, reverse=True)
    by_v = input_adjoint(system.B, following)
    if on_input is not None:
        by_v = by_v + on_input
    h = by_input.at[:-1].add(by_v)
    return feedforward_adjoint(h, path.w, problem.memory)


def recover_noise(
    problem: PerformativeProblem, x: Float[Array, "T1 n"], u: Float[Array, "T1 m"], A: Float[Array, "T n n"]
) -> Float[Array, "T n"]:
    """w_t = x_{t+1} - A_t x_t - B_t u_t from an observed path (Algorithm 1).

    Args:
        problem: whose B_t it is.
        x: states, (T+1, n).
        u: inputs, (T+1, m).
        A: the perturbed state matrices A_t + Δ_t, (T, n, n).

    Returns:
        The noise, (T, n).

    Raises:
        InputError: shapes that do not fit.
    """
    n, m = check_problem(problem).state_size, problem.input_size
    x, u, A = as_array("x", x), as_array("u", u), as_array("A", A)
    if x.ndim != 2 or len(x) < 2:
        raise fail("x", f"{x.shape}", f"have shape (T+1, n) with n = {n}", "Pass one path, its first state included.")
    T = len(x) - 1
    check_shape("x", x, (T + 1, n), ("T+1", "n"))
    check_shape("u", u, (T + 1, m), ("T+1", "m"))
    check_shape("A", A, (T, n, n), ("T", "n", "n"))
    return x[1:] - jnp.einsum("tij,tj->ti", A, x[:-1]) - input_term(problem.system.B, u)


def _sampled(problem: PerformativeProblem, policy: Array, deployed: Array, key: Key[Array, ""]) -> Array:
    return _by_policy(problem, sample_along(problem, policy, deployed, key))


def mean_path_gradient(
    problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""], samples: int, devices: int = 1
) -> Array:
    """Mean over `samples` paths of ∇_1 along each path; pure, for use inside compiled loops."""
    policy, reacting = problem.structure.lift(M), problem.structure.lift(deployed)

    def one(path_key: Array) -> Array:
        by_policy = by_kernel(_sampled, problem, policy, reacting, path_key, gradient=True)
        return problem.structure.adjoint(by_policy)

    if samples == 1:
        return one(key)
    return jnp.mean(over_paths(problem, one, key, samples, along=True, devices=devices), axis=0)


_compiled_mean_path_gradient = program(mean_path_gradient, on_device=True)


def sample_gradient(
    problem: PerformativeProblem,
    M: Any,
    *,
    deployed: Any = None,
    key: Any = None,
    samples: int = 1,
    truncation: int | None = None,
) -> Array:
    """Mean pathwise gradient ∇_1 C_T(M; deployed): unbiased, from simulated paths.

    On an infinite horizon per stage of paths of `truncation` steps, with a bias of the order 1/truncation.

    Args:
        problem: the problem.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise, the policy that the world reacts to; None for M itself.
        key: JAX random key; required.
        samples: number of paths.
        truncation: T of the paths, for an infinite horizon and only there.

    Returns:
        Shape `problem.policy_shape`.

    Raises:
        InputError: wrong shapes, a missing key, samples < 1, an infinite horizon without truncation.
    """
    asked = check_paths(problem, M, deployed, key, samples, truncation)
    return asked.weight * _compiled_mean_path_gradient(*asked.arguments)
