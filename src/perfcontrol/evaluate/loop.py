"""What exact evaluation needs of the closed loop: mean matrices, stage weights seen through u = v - K x, spread."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol._linalg import Matrix, as_dense, transpose
from perfcontrol.costs import QuadraticCost
from perfcontrol.perturbations import CovarianceOperator
from perfcontrol.problem import PerformativeProblem

SIMULATE = (
    "Use pc.estimate_cost and pc.sample_gradient, which only simulate; best responses and solvers sample given key=."
)


class Loop(NamedTuple):
    """The closed loop under a deployed policy, on (x_t, v_t); T is `problem.steps`.

    F: A - BK + Θ and B: with Θ's part on the input; (n, n) and (n, m), with the axis T where they vary. on_x, between,
    on_v: the stage weight on x, (n, n), between v and x, (m, n), None for zero, and on v, (m, m), with the axis T+1
    where they vary. spread: of Δ_t. state_part: [I; -K_t], (T, n+m, n), where Δ acts on the input, too; else None.
    """

    F: Matrix
    B: Matrix
    on_x: Array
    between: Array | None
    on_v: Array
    spread: CovarianceOperator
    state_part: Array | None


def require_moments(problem: PerformativeProblem) -> None:
    """Raise unless the cost is what exact evaluation needs; of the perturbation, `known_covariance` says."""
    if not isinstance(problem.cost, QuadraticCost):
        raise fail("cost", type(problem.cost).__name__, "be a QuadraticCost for exact evaluation", SIMULATE)


def known_covariance(problem: PerformativeProblem, reacting: Array) -> CovarianceOperator:
    """The covariance operator of the perturbation; raises where the law does not know it."""
    spread = problem.perturbation.covariance(reacting, problem.steps)
    if spread is None:
        raise fail(
            "perturbation",
            f"{type(problem.perturbation).__name__} without known moments",
            "know its mean and covariance for exact evaluation",
            SIMULATE,
        )
    return spread


def _stage_weights(problem: PerformativeProblem) -> tuple[Array, Array | None, Array]:
    """`on_x`, `between` and `on_v` of the loop."""
    cost = problem.cost
    assert isinstance(cost, QuadraticCost)
    Q, R, cross = cost.weights(problem.steps)
    between = None if cross is None else transpose(cross)
    if not problem.has_gain:
        return Q, between, R
    K = problem.gain
    on_x = Q + transpose(K) @ R @ K
    if between is None:
        return on_x, -R @ K, R
    mixed = transpose(K) @ between
    return on_x - mixed - transpose(mixed), between - R @ K, R


def closed_loop(problem: PerformativeProblem, reacting: Array) -> Loop:
    """The loop under the lifted deployed policy `reacting`."""
    n, m, T = problem.state_size, problem.input_size, problem.steps
    A, B = problem.system.A, problem.system.B
    on_input = problem.perturbation.columns(n, m) > n
    Theta = problem.perturbation.mean_operator(reacting, T)
    if Theta is not None and on_input:
        joint = as_dense(Theta)
        A, B = A + joint[..., :n], B + joint[..., n:]
    elif Theta is not None:
        A = A + Theta
    spread = known_covariance(problem, reacting)
    state_part = None
    if on_input:
        K = problem.gains()[:T]
        state_part = jnp.concatenate([jnp.broadcast_to(jnp.eye(n, dtype=K.dtype), (T, n, n)), -K], axis=1)
    return Loop(problem.closed_loop(A, B), B, *_stage_weights(problem), spread, state_part)
