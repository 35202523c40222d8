"""What a path draws from its key: the initial state, the noise, the perturbations."""

import jax
from jaxtyping import Array, Key

from perfcontrol.perturbations import Draws
from perfcontrol.problem import PerformativeProblem


def draw_start(
    problem: PerformativeProblem, deployed: Array, key: Key[Array, ""]
) -> tuple[Array, Key[Array, ""], Key[Array, ""]]:
    """Initial state (n,) of one path, the key of its noise and that of its perturbations; `deployed` is lifted."""
    initial_key, noise_key, perturbation_key = jax.random.split(key, 3)
    x0 = problem.initial_state.sample(initial_key, 1)[0].astype(deployed.dtype)
    return x0, noise_key, perturbation_key


def draw_noise(problem: PerformativeProblem, deployed: Array, key: Key[Array, ""]) -> tuple[Array, Array, Array]:
    """Initial state (n,) and noise (T, n) of one path, and the key of its perturbations; `deployed` is lifted."""
    x0, noise_key, perturbation_key = draw_start(problem, deployed, key)
    return x0, problem.noise_under(deployed).sample(noise_key, problem.horizon).astype(deployed.dtype), perturbation_key


def draw_path(problem: PerformativeProblem, deployed: Array, key: Key[Array, ""]) -> tuple[Array, Array, Draws]:
    """Initial state (n,), noise (T, n) and perturbations of one path; `deployed` is lifted."""
    x0, w, perturbation_key = draw_noise(problem, deployed, key)
    return x0, w, problem.perturbation.sample(perturbation_key, deployed, problem.horizon)
