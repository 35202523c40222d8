"""What the parts of a problem know of themselves, read in one program instead of one small one an operation."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.errors
import numpy as np
from jaxtyping import Array

from perfcontrol._programs import program
from perfcontrol.costs import QuadraticCost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response.projected import nearest


def read(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` as a program, its numbers as NumPy arrays; step by step where a part insists on seeing numbers."""
    compiled = program(function)

    def call(*arguments: Any) -> Any:
        try:
            return compiled(*arguments)
        except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError):
            return jax.tree.map(np.asarray, function(*arguments))

    return call


class Facts(NamedTuple):
    """Numbers of one problem; None where the part that should know does not.

    noise_mean: (n,) or (T, n), noise_covariance: (n, n) or (T, n, n), of w_t (where it reacts, under the policy nearest
    to zero). noise_bound, initial_bound: of ‖w_t‖ and ‖x_0‖. radius: sup ‖M‖_F, free parameters.
    perturbation_bound, sensitivity: ξ_t and ε_t, (T,). perturbation_mean: E Δ_t under that policy, (T, n, p).
    stage_matrix, stage_linear: of a quadratic stage cost, (T+1, n+m, n+m) and (T+1, n+m).
    """

    noise_mean: Any
    noise_covariance: Any
    noise_bound: Any
    initial_bound: Any
    radius: Any
    perturbation_bound: Any
    sensitivity: Any
    perturbation_mean: Any
    stage_matrix: Any
    stage_linear: Any

    @property
    def noise_has_mean(self) -> bool:
        """Whether E w_t is not zero at all times."""
        return bool(np.any(self.noise_mean))


@read
def _facts(problem: PerformativeProblem, policy: Array) -> Facts:
    lifted, T = problem.structure.lift(policy), problem.steps
    noise = problem.noise_under(lifted)
    form = problem.cost.form(T) if isinstance(problem.cost, QuadraticCost) else None
    return Facts(
        noise_mean=noise.mean,
        noise_covariance=noise.covariance,
        noise_bound=noise.bound,
        initial_bound=problem.initial_state.bound,
        radius=problem.feasible_set.radius(problem.policy_shape),
        perturbation_bound=problem.perturbation_bound(),
        sensitivity=problem.sensitivity(),
        perturbation_mean=problem.perturbation.mean(lifted, T),
        stage_matrix=None if form is None else form.matrix,
        stage_linear=None if form is None else form.linear,
    )


def facts(problem: PerformativeProblem) -> Facts:
    """What the problem's parts know of themselves."""
    return _facts(problem, nearest_to_zero(problem))


def nearest_to_zero(problem: PerformativeProblem) -> np.ndarray:
    """The feasible policy nearest to zero, on the host."""
    return nearest(problem.feasible_set, np.zeros(problem.policy_shape, problem.dtype))


@read
def in_free_parameters(problem: PerformativeProblem, slopes: Array) -> Array:
    """Derivatives by the lifted policy, (..., memory, m, n), as ones by the free parameters, (..., p)."""
    flat = slopes.reshape(-1, *problem.lifted_shape)
    return jax.vmap(problem.structure.adjoint)(flat).reshape(*slopes.shape[:-3], -1)
