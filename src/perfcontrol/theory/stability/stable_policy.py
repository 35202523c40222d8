"""Finding a stable policy by exact solvers, and proving that there is none where its equation is affine."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol.evaluate.exact import expected_gradient
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import AbstractSolver, Continuation, Result, Solution, StablePoint, solve
from perfcontrol.theory.derivatives import hessian, reaction_jacobian, tangent_basis
from perfcontrol.theory.existence import set_radius

CONTINUED = 256  # free parameters up to which a stable policy is also looked for by continuation
AFFINE_TOLERANCE = 1e-9


def find_stable_policy(problem: PerformativeProblem, starts: int = 3) -> Solution:
    """The exact solver from the policy nearest to zero, then from random ones; on a bounded set then continuation."""
    draws = jax.random.normal(jax.random.key(1), (starts - 1, *problem.policy_shape), problem.dtype)
    centre, project = problem.initial_policy(), problem.feasible_set.project
    attempts: list[tuple[AbstractSolver, Array]] = [(StablePoint(), centre)]
    attempts += [(StablePoint(), project(centre + draw)) for draw in draws]
    if set_radius(problem) is not None and centre.size <= CONTINUED:
        attempts.append((Continuation(), centre))
    solution = None
    for solver, start in attempts:
        other = solve(problem, solver, start, throw=False)
        if other.result == Result.success:
            return other
        solution = solution or other
    assert solution is not None
    return solution


def proves_absence(problem: PerformativeProblem) -> bool:
    """Whether g(M; M) is affine in M (checked at points) and has no zero on an affine feasible set."""
    if not problem.feasible_set.affine:
        return False
    base = problem.initial_policy()
    basis = tangent_basis(problem)

    def field(v: np.ndarray) -> np.ndarray:
        M = base + jnp.asarray(basis @ v, base.dtype).reshape(base.shape)
        return basis.T @ np.asarray(expected_gradient(problem, M), dtype=float).reshape(-1)

    q = basis.shape[1]
    origin = field(np.zeros(q))
    matrix = basis.T @ (hessian(problem, base) + reaction_jacobian(problem, base, base)) @ basis
    points = np.random.default_rng(0).standard_normal((4, q)) * np.array([[0.3], [1.0], [3.0], [10.0]])
    for point in points:
        value = field(point)
        scale = np.abs(value).max() + np.abs(origin).max() + np.abs(matrix).max() * np.abs(point).max()
        if np.abs(value - origin - matrix @ point).max() > AFFINE_TOLERANCE * scale:
            return False
    solved = np.linalg.lstsq(matrix, -origin, rcond=1e-10)[0]
    return bool(np.linalg.norm(matrix @ solved + origin) > 1e-6 * np.linalg.norm(origin))
