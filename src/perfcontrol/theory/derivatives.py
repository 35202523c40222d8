"""First-order structure of a quadratic problem: Hessian, reaction Jacobian, tangent spaces, as host matrices.

With g(M; M') = ∇_1 C_T(M; M') in the free parameters (p of them): 𝐇 = ∂_1 g, 𝐄 = ∂_2 g. The derivative of the
best response is Φ' = -𝐇⁻¹𝐄 where no constraint is active, that of projected descent P (I - η(𝐇+𝐄)), P the
derivative of the projection.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol._linalg import along_time
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.exact import exact_gradient
from perfcontrol.perturbations import NoPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import AbstractRandomVector
from perfcontrol.systems import LinearSystem

DENSE_LIMIT = 1500  # free parameters up to which p × p matrices are built


def check_problem(problem: object) -> PerformativeProblem:
    """`problem` itself; raises InputError for anything else."""
    if not isinstance(problem, PerformativeProblem):
        raise fail("problem", type(problem).__name__, "be a PerformativeProblem", "Build it first.")
    return problem


def obstacles(problem: PerformativeProblem) -> list[str]:
    """Why these matrices cannot be built; empty if they can."""
    missing = []
    if not isinstance(problem.cost, QuadraticCost):
        missing.append("the cost is not quadratic: pass cost=pc.QuadraticCost(Q, R)")
    policy = jax.ShapeDtypeStruct(problem.lifted_shape, problem.dtype)
    if eqx.filter_eval_shape(lambda law, M: law.covariance(M, problem.horizon), problem.perturbation, policy) is None:
        family = type(problem.perturbation).__name__
        wanted = "perturbation=pc.DirectionalPerturbation(directions, scale)"
        missing.append(f"{family} does not know its mean and covariance: pass a family that does, such as {wanted}")
    if (size := math.prod(problem.policy_shape)) > DENSE_LIMIT:
        missing.append(
            f"{size} free parameters are more than {DENSE_LIMIT}: pass a shorter memory, memory=1, or a structure such "
            "as structure=pc.RepeatedBlock(2)"
        )
    return missing


@eqx.filter_jit
def _columns(problem: PerformativeProblem, M: Array, deployed: Array, which: str) -> Array:
    def gradient(V: Array) -> Array:
        pair = (M + V, deployed) if which == "policy" else (M, deployed + V)
        return exact_gradient(problem, *pair)

    _, push = jax.linearize(gradient, jnp.zeros_like(M))
    eye = jnp.eye(M.size, dtype=M.dtype).reshape(M.size, *M.shape)
    return jax.lax.map(push, eye, batch_size=min(16, M.size)).reshape(M.size, M.size)


def hessian(problem: PerformativeProblem, deployed: Array) -> np.ndarray:
    """𝐇 = ∂_1 g under the deployed policy, (p, p) symmetric."""
    matrix = np.asarray(_columns(problem, jnp.zeros_like(deployed), deployed, "policy"), dtype=float)
    return (matrix + matrix.T) / 2


def reaction_jacobian(problem: PerformativeProblem, M: Array, deployed: Array) -> np.ndarray:
    """𝐄 = ∂_2 g at (M, deployed), (p, p): how the gradient moves with the deployed policy."""
    return np.asarray(_columns(problem, M, deployed, "deployed"), dtype=float).T


def fixed_noise(problem: PerformativeProblem) -> AbstractRandomVector:
    """The law of w_t; where it reacts, the one under the initial policy."""
    return problem.noise_under(problem.structure.lift(problem.initial_policy()))


def without_reaction(problem: PerformativeProblem) -> PerformativeProblem:
    """The problem at Δ_t = E Δ_t: no randomness in the dynamics, and no reaction (for means free of the policy)."""
    n, m, T = problem.state_size, problem.input_size, problem.horizon
    mean = problem.perturbation.mean(problem.structure.lift(problem.initial_policy()), T)
    assert mean is not None
    A = along_time(problem.system.A, 2, T) + mean[..., :n]
    B = along_time(problem.system.B, 2, T)
    if mean.shape[-1] == n + m:
        B = B + mean[..., n:]
    return eqx.tree_at(
        lambda p: (p.system, p.perturbation),
        problem,
        (LinearSystem(A, B), NoPerturbation()),
        is_leaf=lambda x: x is None,
    )


def hessian_without_reaction(problem: PerformativeProblem) -> np.ndarray:
    """𝐇 at Δ_t = E Δ_t: by Jensen's inequality 𝐇 under every law with that mean is at least as large."""
    calm = without_reaction(problem)
    return hessian(calm, calm.initial_policy())


def projection_derivative(problem: PerformativeProblem, point: Array) -> np.ndarray:
    """The derivative (p, p) of the projection onto the feasible set at `point`."""
    shape, size = problem.policy_shape, point.size
    project: Callable[[Array], Array] = problem.feasible_set.project
    slope = jax.jacfwd(lambda v: project(v.reshape(shape)).reshape(-1))(point.reshape(-1))
    return np.asarray(slope, dtype=float).reshape(size, size)


def range_basis(matrix: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the range of a symmetric matrix with eigenvalues in [0, 1]."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return vectors[:, values > 1e-6]


def tangent_basis(problem: PerformativeProblem) -> np.ndarray:
    """An orthonormal basis (p, q) of the directions that keep an affine set; of all directions for other sets.

    Row sums are kept by `RowSimplex` too: its affine hull is that of `RowSum`.
    """
    size = int(np.prod(problem.policy_shape))
    if problem.feasible_set.affine:
        return range_basis(projection_derivative(problem, problem.initial_policy()))
    if problem.feasible_set.row_total is not None:
        n = problem.policy_shape[-1]
        centring = np.eye(n) - np.full((n, n), 1 / n)
        return range_basis(np.kron(np.eye(size // n), centring))
    return np.eye(size)
