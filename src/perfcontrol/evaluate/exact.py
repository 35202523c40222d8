"""Exact cost and gradient of a policy for quadratic stage costs, without sampling.

Given the cost-to-go of the deployed world, impulses w_s cost a quadratic form in the policy (`impulses`), the
deterministic means cost what one mean path costs (`mean_path`), and the covariance of x_0 costs tr Λ_0 Cov(x_0).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import check_finite, fail
from perfcontrol._linalg import along_time, symmetrise
from perfcontrol._programs import known, program
from perfcontrol.evaluate.cost_to_go import World
from perfcontrol.evaluate.impulses import constant_impulses, varying_impulses
from perfcontrol.evaluate.loop import require_moments
from perfcontrol.evaluate.mean_path import mean_path
from perfcontrol.evaluate.rollout import check_pair
from perfcontrol.evaluate.stationary import StationaryWorld, mean_square_radius, mean_stage
from perfcontrol.evaluate.world import world_of
from perfcontrol.policy import feedforward, feedforward_adjoint
from perfcontrol.problem import PerformativeProblem

ROUNDINGS = 1000  # of the largest term of a cost: of fewer, not two digits are certain


def cost_and_gradient(problem: PerformativeProblem, world: World, policy: Array) -> tuple[Array, Array]:
    """C_T and ∇_1 C_T at a lifted policy, given the world that the deployed policy makes; per stage in the limit."""
    covariance, mean = world.noise_covariance, world.noise_mean
    if isinstance(world, StationaryWorld):
        cost, gradient = constant_impulses(world, policy, covariance)
        deterministic, by_v = mean_stage(problem, world, jnp.sum(policy, axis=0) @ mean)
        return cost + deterministic, gradient + jnp.outer(by_v, mean)
    impulses = constant_impulses if covariance.ndim == 2 else varying_impulses
    cost, gradient = impulses(world, policy, covariance)
    w = along_time(mean, 1, problem.horizon)
    deterministic, by_v = mean_path(problem, world, feedforward(policy, w), w, problem.initial_state.mean)
    start = jnp.sum(world.first * problem.initial_state.covariance)
    return cost + deterministic + start, gradient + feedforward_adjoint(by_v, w, problem.memory)


@program
def weigh(problem: PerformativeProblem, world: World, M: Any) -> tuple[Array, Array]:
    """`cost_and_gradient` of free parameters, the gradient by them."""
    cost, gradient = cost_and_gradient(problem, world, problem.structure.lift(M))
    return cost, problem.structure.adjoint(gradient)


def exact_cost(problem: PerformativeProblem, M: Any, deployed: Any) -> Any:
    """C_T(M; deployed), free parameters; pure, differentiable in both."""
    return weigh(problem, world_of(problem, deployed), M)[0]


def exact_gradient(problem: PerformativeProblem, M: Any, deployed: Any) -> Any:
    """∇_1 C_T(M; deployed) in the free parameters; pure, differentiable in both."""
    return weigh(problem, world_of(problem, deployed), M)[1]


@program
def value_and_total_gradient(problem: PerformativeProblem, M: Any) -> tuple[Array, Array]:
    """C_T(M; M) and d/dM C_T(M; M) in the free parameters."""
    return jax.value_and_grad(lambda policy: exact_cost(problem, policy, policy))(M)


@program
def values_and_total_gradients(problem: PerformativeProblem, policies: Any) -> tuple[Array, Array]:
    """The same of several policies, stacked along the first axis."""
    return jax.vmap(lambda M: value_and_total_gradient(problem, M))(policies)


@program
def total_hessian(problem: PerformativeProblem, M: Any) -> Array:
    """d²/dM² C_T(M; M) in the free parameters, (p, p)."""
    _, push = jax.linearize(lambda policy: value_and_total_gradient(problem, policy)[1], M)
    eye = jnp.eye(M.size, dtype=M.dtype).reshape(M.size, *M.shape)
    return symmetrise(jax.lax.map(push, eye, batch_size=min(16, M.size)).reshape(M.size, M.size))


def check_answer(what: str, answer: Any, problem: PerformativeProblem, deployed: Any) -> Array:
    """`answer` where it is finite (or traced); else the error that says why it is not."""
    if problem.is_finite or not known(answer, problem, deployed) or np.all(np.isfinite(answer)):
        return jnp.asarray(check_finite(what, answer))
    radius = float(mean_square_radius(problem, deployed))
    raise fail(
        "deployed",
        f"a policy under which second moments grow by the factor {radius:.6g} a stage (spectral radius)",
        "keep the world mean-square stable, with a spectral radius clearly below 1",
        "Deploy a policy of smaller norm, or use a stabilising gain, as of pc.design_gain.",
    )


def check_digits(cost: Any, problem: PerformativeProblem, world: World) -> None:
    """Raise OverflowError where `cost` is no more than the rounding of what it would be without feedforward.

    Where the deployed world grows, a policy works by cancelling: C = tr Σ(a + 2FᵀM̂ + M̂ᵀG M̂) is then a difference of
    terms as large as the cost of M = 0, which carry its rounding.
    """
    if isinstance(world, StationaryWorld) or not known(cost, world):
        return
    cost, Lambda = np.asarray(cost), np.asarray(world.Lambda)  # JAX would compile a program for each step of this
    if np.max(Lambda) <= 100 * np.max(Lambda[-1]):  # definite: the largest entry is on the diagonal
        return
    free, _ = weigh(problem, world, np.zeros(problem.policy_shape, cost.dtype))
    if cost < ROUNDINGS * np.finfo(cost.dtype).eps * free:
        raise OverflowError(
            f"the expected cost is lost in the rounding of {cost.dtype.name}: without feedforward the same world costs "
            f"{float(free):.3g}, and what this policy leaves of it has no certain digit. Use a stabilising gain, as of "
            "pc.design_gain, or a shorter horizon."
        )


def expected_cost(problem: PerformativeProblem, M: Any, *, deployed: Any = None) -> Array:
    """Exact C_T(M; deployed) = E Σ_{t=0..T} c_t(x_t, u_t); `deployed=None` means M: the performative cost.

    With `horizon=math.inf` the average cost per stage in the long run.

    Beware: `jax.grad(lambda M: expected_cost(problem, M))` differentiates in both policies, which is the gradient
    of the performative optimum, not the one that performative stability is about. See `expected_gradient`.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise, the policy that the world reacts to; None for M itself.

    Returns:
        A scalar.

    Raises:
        InputError: wrong shapes, a cost or perturbation without closed moments; on an infinite horizon a deployed
            policy whose world is not mean-square stable.
        OverflowError: the answer is too large for the precision of the problem, or lost in rounding where the policy
            cancels a growth of many digits.
    """
    M, reacting = check_pair(problem, M, deployed)
    require_moments(problem)
    world = world_of(problem, reacting)
    cost = check_answer("the expected cost", weigh(problem, world, M)[0], problem, reacting)
    check_digits(cost, problem, world)
    return cost


def expected_gradient(problem: PerformativeProblem, M: Any, *, deployed: Any = None, total: bool = False) -> Array:
    """Exact ∇_1 C_T(M; deployed), the first argument alone; `total=True`: the derivative of C_T(M; M).

    A performatively stable policy has ∇_1 C_T(M; M) = 0 (or satisfies the variational inequality on the feasible
    set); a performatively optimal one has a zero total gradient.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise, the policy that the world reacts to; None for M itself.
        total: differentiate in both policies together; then `deployed` is left out.

    Returns:
        Shape `problem.policy_shape`.

    Raises:
        InputError: as `expected_cost`; `total=True` together with another deployed policy, or where the reaction has
            no finite derivative.
    """
    M, reacting = check_pair(problem, M, deployed)
    require_moments(problem)
    if not total:
        return check_answer("the expected gradient", exact_gradient(problem, M, reacting), problem, reacting)
    if deployed is not None:
        raise fail(
            "deployed",
            "a policy together with total=True",
            "be left out for the total gradient",
            "Leave it out: the total derivative moves both policies together.",
        )
    cost, gradient = value_and_total_gradient(problem, M)
    if known(cost, gradient) and np.isfinite(cost) and not np.all(np.isfinite(gradient)) and _calm(problem, M):
        raise fail(
            "perturbation",
            "a reaction whose derivative is not finite at this policy",
            "have a derivative by the policy where the total gradient is asked for",
            "Write norms as pc.Norm; jnp.linalg.norm has no derivative at zero.",
        )
    return check_answer("the total gradient", gradient, problem, M)


def _calm(problem: PerformativeProblem, M: Any) -> bool:
    """Whether the derivative in the evaluated policy alone is finite, so that nothing overflows but the reaction's."""
    return bool(np.all(np.isfinite(exact_gradient(problem, M, M))))
