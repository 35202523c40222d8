"""First-order structure of a quadratic problem: Hessian, reaction Jacobian, tangent spaces, as host matrices.

With g(M; M') = ∇_1 C_T(M; M') in the free parameters (p of them): 𝐇 = ∂_1 g, 𝐄 = ∂_2 g. The derivative of the
best response is Φ' = -𝐇⁻¹𝐄 where no constraint is active, that of projected descent P (I - η(𝐇+𝐄)), P the
derivative of the projection.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._linalg import as_dense
from perfcontrol._programs import on_host, program
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.cost_to_go import CostToGo, cost_to_go
from perfcontrol.evaluate.world import world_of
from perfcontrol.perturbations import NoPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import response_hessian
from perfcontrol.response.affine import tangent_space
from perfcontrol.response.projected import projection_slope
from perfcontrol.systems import LinearSystem
from perfcontrol.theory.facts import nearest_to_zero
from perfcontrol.theory.precision import in_double

DENSE_LIMIT = 1500  # free parameters up to which p × p matrices are built


def obstacles(problem: PerformativeProblem) -> list[str]:
    """Why these matrices cannot be built; empty if they can."""
    missing = []
    if not isinstance(problem.cost, QuadraticCost):
        missing.append("the cost is not quadratic: pass cost=pc.QuadraticCost(Q, R)")
    policy = jax.ShapeDtypeStruct(problem.lifted_shape, problem.dtype)
    if eqx.filter_eval_shape(lambda law, M: law.covariance(M, problem.steps), problem.perturbation, policy) is None:
        family = type(problem.perturbation).__name__
        wanted = "perturbation=pc.DirectionalPerturbation(directions, scale)"
        missing.append(f"{family} does not know its mean and covariance: pass a family that does, such as {wanted}")
    if (size := math.prod(problem.policy_shape)) > DENSE_LIMIT:
        missing.append(
            f"{size} free parameters are more than {DENSE_LIMIT}: pass a shorter memory, memory=1, or a structure such "
            "as structure=pc.RepeatedBlock(2)"
        )
    return missing


@in_double
def hessian(problem: PerformativeProblem, deployed: Any) -> np.ndarray:
    """𝐇 = ∂_1 g under the deployed policy, (p, p) symmetric."""
    return np.asarray(response_hessian(problem, world_of(problem, on_host(deployed))), dtype=float)


@program
def _calm_world(problem: PerformativeProblem, policy: Any) -> CostToGo:
    """The cost-to-go at Δ_t = E Δ_t under a policy."""
    n, T = problem.state_size, problem.horizon
    lifted = problem.structure.lift(policy)
    A, B = problem.system.A, problem.system.B
    mean = problem.perturbation.mean_operator(lifted, T)
    if mean is not None:
        mean = as_dense(mean)
        A, B = A + mean[..., :n], B + mean[..., n:] if mean.shape[-1] > n else B
    return cost_to_go(
        eqx.tree_at(lambda p: (p.system, p.perturbation), problem, (LinearSystem(A, B), NoPerturbation())), lifted
    )


def hessian_without_reaction(problem: PerformativeProblem, weights: np.ndarray | None = None) -> np.ndarray:
    """𝐇 at Δ_t = E Δ_t: by Jensen's inequality 𝐇 under every law with that mean is at least as large.

    Of the problem's quadratic cost, or of E Σ weight_t (‖x_t‖² + ‖u_t‖²), weights (T+1,); for means free of the policy.
    """
    if weights is not None:
        dtype, cross = problem.dtype, getattr(problem.cost, "cross", None)
        scale = weights[0] if np.all(weights == weights[0]) else weights[:, None, None]
        Q, R = (jnp.asarray(scale * np.eye(size), dtype) for size in (problem.state_size, problem.input_size))
        # the same arrays as in the problem's own cost, where it has any: then the programs are the same too
        cost = QuadraticCost(Q, R, None if cross is None else jnp.zeros_like(cross))
        problem = eqx.tree_at(lambda p: p.cost, problem, cost)
    world = _calm_world(problem, nearest_to_zero(problem))
    return np.asarray(response_hessian(problem, world), dtype=float)


@in_double
def projection_derivative(problem: PerformativeProblem, point: Any) -> np.ndarray:
    """The derivative (p, p) of the projection onto the feasible set at `point`."""
    return np.asarray(projection_slope(problem.feasible_set, on_host(point)), dtype=float)


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
        return range_basis(np.asarray(tangent_space(problem.feasible_set, nearest_to_zero(problem))[1], dtype=float))
    if problem.feasible_set.row_total is not None:
        n = problem.policy_shape[-1]
        centring = np.eye(n) - np.full((n, n), 1 / n)
        return range_basis(np.kron(np.eye(size // n), centring))
    return np.eye(size)
