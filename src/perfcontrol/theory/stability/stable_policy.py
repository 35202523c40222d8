"""Finding a stable policy by exact solvers, and proving that there is none where its equation is affine."""

from collections.abc import Iterator

import jax
import numpy as np

from perfcontrol.evaluate.exact import exact_gradient
from perfcontrol.evaluate.reaction import reaction_jacobian
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response.projected import nearest
from perfcontrol.solvers import Result, Solution, StablePoint, solve
from perfcontrol.theory.derivatives import hessian, tangent_basis
from perfcontrol.theory.facts import nearest_to_zero

AFFINE_TOLERANCE = 1e-9


def find_stable_policy(problem: PerformativeProblem, starts: int = 3) -> Solution:
    """The exact solver from the policy nearest to zero, then from random ones."""
    first = None
    for start in _starts(problem, starts):
        solution = solve(problem, StablePoint(), start, throw=False)
        if solution.result == Result.success:
            return solution
        first = first or solution
    assert first is not None
    return first


def _starts(problem: PerformativeProblem, count: int) -> Iterator[np.ndarray]:
    centre = nearest_to_zero(problem)
    yield centre
    for draw in jax.random.normal(jax.random.key(1), (count - 1, *centre.shape), centre.dtype):
        yield nearest(problem.feasible_set, centre + np.asarray(draw))


def proves_absence(problem: PerformativeProblem) -> bool:
    """Whether g(M; M) is affine in M (checked at points) and has no zero on an affine feasible set."""
    if not (problem.feasible_set.affine and problem.is_finite):
        return False
    base, basis = nearest_to_zero(problem), tangent_basis(problem)

    def field(v: np.ndarray) -> np.ndarray:
        M = base + (basis @ v).astype(base.dtype).reshape(base.shape)
        return basis.T @ np.asarray(exact_gradient(problem, M, M), dtype=float).reshape(-1)

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
