"""The best response Φ(M') = argmin over the feasible set of C_T(·; M'), exactly, for quadratic stage costs.

C_T(·; M') is a convex quadratic in the free parameters. One engine serves best responses, repeated minimisation,
stable points and theory; `methods` says which method serves which problem. Iterations run on frozen
numbers; the derivative of Φ comes from one Newton step at the minimiser (implicit function theorem), never from
differentiating a loop.
"""

import functools
import operator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from perfcontrol._linalg import frobenius
from perfcontrol._programs import known, numerics, on_host, program
from perfcontrol.evaluate.cost_to_go import World
from perfcontrol.evaluate.exact import check_answer, exact_gradient, expected_gradient, weigh
from perfcontrol.evaluate.loop import require_moments
from perfcontrol.evaluate.reaction import reaction_jacobian
from perfcontrol.evaluate.rollout import check_pair
from perfcontrol.evaluate.world import world_of
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.response.affine import AffineByProducts
from perfcontrol.response.estimate import SampleAverage, estimate_response, is_exact
from perfcontrol.response.methods import is_free, is_held, method_of, shape_of_cost, step_length
from perfcontrol.response.projected import gradient_steps, nearest
from perfcontrol.response.quadratic import Operator, stationary
from perfcontrol.response.sampled import Sampled, approach, minimise, sampled_jacobian, sampled_residual


class Response(NamedTuple):
    """A best response.

    M: of least norm on affine sets; NaN where the world overflows. unique: whether it is the only one. residual: of the
    deployed policy itself, as `natural_residual` without a pass over time of its own; None where responses are sampled.
    """

    M: Any
    unique: Any
    residual: Any = None


def _on_host(problem: PerformativeProblem, deployed: Any, *others: Any) -> bool:
    """Whether the method works on the host, step by step: where the Hessian is held, or its factors are regular."""
    if not known(problem, deployed, *others):
        return False
    return is_held(problem) or (is_free(problem) and stationary(jax.eval_shape(world_of, problem, deployed)))


def is_sound(form: Any) -> Any:
    """Whether all numbers are finite."""
    xp, _ = numerics(form)
    finite = [xp.all(xp.isfinite(leaf)) for leaf in jax.tree.leaves(form) if not callable(leaf)]
    return functools.reduce(operator.and_, finite)


def _respond(problem: PerformativeProblem, deployed: Any, start: Any, inner_steps: int | None) -> Response:
    world = world_of(problem, deployed)
    form = shape_of_cost(problem, world)
    xp, _ = numerics(form, start)
    sound = is_sound(form)
    if known(sound) and not sound:
        return Response(xp.full_like(start, xp.nan), xp.asarray(False), xp.asarray(xp.inf, start.dtype))
    if inner_steps is None:
        method = method_of(problem, world, form)
        step, (M, unique) = method.step, method.minimise(start)
    else:
        step = step_length(problem, world, form)
        M, unique = gradient_steps(problem.feasible_set, form.gradient, step, start, inner_steps), xp.asarray(True)
    residual = moved_by(problem, form, step, deployed, form.gradient(deployed))
    # Pseudo-inverses turn an overflow into finite nonsense: no number at all is the honest answer.
    return Response(xp.where(sound, M, xp.nan), unique, xp.where(sound, residual, xp.inf))


def moved_by(problem: PerformativeProblem, form: Any, step: Any, M: Any, gradient: Any) -> Any:
    """‖M - Proj(M - step·gradient)‖_F relative to ‖M‖_F + step ‖linear‖_F."""
    moved = frobenius(M - nearest(problem.feasible_set, M - step * gradient))
    scale = frobenius(M) + frobenius(step * form.linear)
    xp, _ = numerics(scale)
    return moved / xp.where(scale > 0, scale, 1)


_respond_in_one_program = program(_respond)


def respond(problem: PerformativeProblem, deployed: Any, start: Any = None, inner_steps: int | None = None) -> Response:
    """Φ(deployed) in the free parameters; pure, works under jit and vmap; carries no derivative.

    With `inner_steps` only so many gradient steps towards it, from `start`; `unique` is then not looked at.
    """
    start = deployed if start is None else start
    if isinstance(problem, Sampled):
        if inner_steps is not None:
            return Response(approach(problem, on_host(deployed), on_host(start), inner_steps), np.asarray(True))
        return Response(*minimise(problem, on_host(deployed), on_host(start)))
    if _on_host(problem, deployed, start):
        with np.errstate(all="ignore"):
            return _respond(problem, on_host(deployed), on_host(start), inner_steps)
    # Loops are not differentiated: nothing that varies goes in.
    arrays, rest = eqx.partition((problem, deployed, start), eqx.is_array)
    return _respond_in_one_program(*eqx.combine(jax.lax.stop_gradient(arrays), rest), inner_steps)


def response_hessian(problem: PerformativeProblem, world: World) -> Any:
    """𝐇 = ∂_1 g in a given world, (p, p); where it is held."""
    return shape_of_cost(problem, world).matrix


def response_jacobian(problem: PerformativeProblem, deployed: Any, response: Any) -> Any:
    """Φ'(deployed), (p, p), given Φ(deployed), by the implicit function theorem; where the Hessian is held."""
    if isinstance(problem, Sampled):
        return sampled_jacobian(problem, on_host(deployed), on_host(response))
    world = world_of(problem, deployed)
    method = method_of(problem, world, shape_of_cost(problem, world))
    assert not isinstance(method, AffineByProducts)
    return method.jacobian(response, reaction_jacobian(problem, response, deployed))


def response_pushforward(problem: PerformativeProblem, deployed: Array, response: Array) -> Operator:
    """V -> Φ'(deployed)[V], given Φ(deployed), by products alone; for use inside programs."""
    if isinstance(problem, Sampled):
        slope = sampled_jacobian(problem, deployed, response)
        return lambda V: (slope @ V.reshape(-1)).reshape(V.shape)
    world = world_of(problem, deployed)
    newton = method_of(problem, world, shape_of_cost(problem, world)).newton(response)
    base, pushforward = jax.linearize(lambda policy: exact_gradient(problem, response, policy), deployed)
    # A Newton step is affine in the gradient to first order at a solution; its value there is zero up to rounding.
    _, step_forward = jax.linearize(newton, base)
    return lambda V: step_forward(pushforward(V))


@eqx.filter_jit
def differentiable_response(problem: PerformativeProblem, deployed: Array) -> Array:
    """Φ(deployed) with its derivative: one Newton step on frozen matrices carries it and changes no value."""
    world = world_of(problem, deployed)
    M = respond(problem, deployed).M
    frozen = jax.lax.stop_gradient(world)
    newton = method_of(problem, frozen, shape_of_cost(problem, frozen)).newton(M)
    corrected = newton(weigh(problem, world, M)[1])
    return M + (corrected - jax.lax.stop_gradient(corrected))


def natural_residual(problem: PerformativeProblem, M: Any, deployed: Any, gradient: Any = None) -> Any:
    """‖M - Proj(M - η g)‖_F relative to ‖M‖_F + η ‖∇_1 C_T(0)‖_F, η = 1/‖Hessian‖.

    g is the gradient given, or ∇_1 C_T(M; deployed) by a pass over time of its own.
    """
    world = world_of(problem, deployed)
    form = shape_of_cost(problem, world)
    xp, _ = numerics(form, M)
    at_M = weigh(problem, world, M)[1] if gradient is None else gradient
    sound = is_sound((form, at_M))
    if known(sound) and not sound:
        return xp.asarray(xp.inf, at_M.dtype)
    return xp.where(sound, moved_by(problem, form, step_length(problem, world, form), M, at_M), xp.inf)


def _step_at(problem: PerformativeProblem, deployed: Any) -> Any:
    world = world_of(problem, deployed)
    form = shape_of_cost(problem, world)
    sound = is_sound(form)
    if known(sound) and not sound:
        return np.asarray(np.nan, problem.dtype)
    return step_length(problem, world, form)


_residual_in_one_program = program(natural_residual)
_step_in_one_program = program(_step_at)


def residual_of(problem: PerformativeProblem, M: Any, deployed: Any, gradient: Any = None) -> Any:
    """`natural_residual`; from the host where that can be, else as one program."""
    if isinstance(problem, Sampled):
        return sampled_residual(problem, on_host(M), on_host(deployed))
    if _on_host(problem, deployed, M):
        with np.errstate(all="ignore"):
            return natural_residual(problem, on_host(M), on_host(deployed), gradient)
    return _residual_in_one_program(problem, M, deployed, gradient)


def step_of(problem: PerformativeProblem, deployed: Any) -> Any:
    """η = 1/‖Hessian of C_T(·; deployed)‖: the length of a safe gradient step; NaN where the world overflows."""
    if _on_host(problem, deployed):
        with np.errstate(all="ignore"):
            return _step_at(problem, on_host(deployed))
    return _step_in_one_program(problem, deployed)


def best_response(
    problem: PerformativeProblem,
    deployed: Any,
    *,
    key: Any = None,
    tolerance: float | None = None,
    sampling: SampleAverage | None = None,
) -> Array:
    """Φ(deployed) = argmin over the feasible set of C_T(·; deployed): what retraining on observed data would give.

    Exact for quadratic costs and known moments; else sampled, which needs a key (see `estimate_response`). Without
    constraint or mean noise it does not depend on the noise covariance, nor on x_0. The least-norm minimiser where
    there are several, the set is affine, and the response exact.

    Args:
        problem: the problem.
        deployed: free policy parameters that the world reacts to.
        key: JAX random key, where the response must be sampled; not used where it is exact.
        tolerance: relative standard error of a sampled response; None for 0.01.
        sampling: how many paths it may use; None for `SampleAverage()`.

    Returns:
        Shape `problem.policy_shape`.

    Raises:
        InputError: wrong shapes; without a key, a cost or perturbation without closed moments.
    """
    deployed = check_problem(problem).check_policy("deployed", deployed)
    if key is not None and not is_exact(problem):
        return estimate_response(problem, deployed, key=key, tolerance=tolerance, sampling=sampling).mean
    require_moments(problem)
    if not known(problem, deployed):
        return differentiable_response(problem, deployed)
    return check_answer("the best response", respond(problem, deployed).M, problem, deployed)


def residual(problem: PerformativeProblem, M: Any, *, deployed: Any = None, total: bool = False) -> Array:
    """Relative natural residual ‖M - Proj(M - ηg)‖_F / (‖M‖_F + η‖∇_1 C_T(0)‖_F), η = 1/‖Hessian‖.

    With g = ∇_1 C_T(M; deployed) it is zero exactly at a best response to `deployed`; with `deployed=None` (M itself)
    at a performatively stable policy. With `total=True` g is the derivative of C_T(M; M), and the residual is zero at a
    performatively optimal policy (and wherever else that cost is stationary).

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise, the policy that the world reacts to; None for M itself.
        total: whether both policies move together.

    Raises:
        InputError: as `best_response`; `total=True` together with another deployed policy.
    """
    M, reacting = check_pair(problem, M, deployed)
    require_moments(problem)
    gradient = expected_gradient(problem, M, deployed=deployed, total=True) if total else None
    return check_answer("the residual", residual_of(problem, M, reacting, gradient), problem, reacting)
