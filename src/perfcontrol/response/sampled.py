"""Best responses by sample-average approximation: expectations become means over paths of a fixed key.

With common random numbers a world is a deterministic function of the deployed policy, and for fixed draws states and
inputs are affine in the policy, so that the mean cost over the paths is convex in it:
    Φ_N(M') = argmin over the feasible set of (1/N) Σ_s J_s(M; M').
Newton steps on quadratic models of it share their minimisation with the exact engine. By the delta method
    Φ_N - Φ ≈ D (ḡ - E g), Cov Φ_N ≈ D Cov(g_s) Dᵀ / N,
where D is the derivative of the minimiser by the gradient, -𝐇⁻¹ without constraints.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._linalg import frobenius, solve
from perfcontrol._programs import Numbers, choose, known, numerics, program, while_loop
from perfcontrol.evaluate.adjoint import path_gradient
from perfcontrol.evaluate.rollout import draw_path, run_path
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response.affine import Affine
from perfcontrol.response.projected import Projected, nearest
from perfcontrol.response.quadratic import Quadratic

LANES = 32  # paths worked on together
NEWTON_STEPS = 60
ARMIJO = 1e-4  # share of the predicted decrease that a step must bring
QUANTILE = 1.6448536269514722  # of the normal law at 95 %


class Sampled(PerformativeProblem):
    """A problem whose expectations are means over the first `samples` paths of a key."""

    key: Key[Array, ""]
    samples: Numbers

    def __init__(self, problem: PerformativeProblem, key: Key[Array, ""], samples: Any):
        for field in dataclasses.fields(PerformativeProblem):
            setattr(self, field.name, getattr(problem, field.name))
        self.key, self.samples = key, samples


class Averages(eqx.Module):
    """Means over the paths at a policy: cost, gradient (policy_shape), Hessian (p, p); covariance (p, p) of the
    gradients of single paths."""

    cost: Numbers
    gradient: Numbers
    hessian: Numbers
    covariance: Numbers


def average(world: Sampled, one: Any, like: Any) -> Any:
    """The mean of `one(key of a path)` over the paths, `LANES` at a time; any number of them without recompilation."""

    def block(index: Array, total: Any) -> Any:
        numbers = index * LANES + jnp.arange(LANES)
        values = jax.vmap(lambda number: one(jax.random.fold_in(world.key, number)))(numbers)
        counts = numbers < world.samples

        def add(total: Array, value: Array) -> Array:
            return total + jnp.sum(jnp.where(counts.reshape(-1, *[1] * (value.ndim - 1)), value, 0), axis=0)

        return jax.tree.map(add, total, values)

    blocks = -(-jnp.asarray(world.samples) // LANES)
    total = jax.lax.fori_loop(0, blocks, block, jax.tree.map(jnp.zeros_like, like))
    return jax.tree.map(lambda leaf: leaf / jnp.asarray(world.samples, leaf.dtype), total)


@program(whole=True)
def averages(world: Sampled, M: Any, deployed: Any) -> Averages:
    """What Newton's method and the standard error need to know at M while the world reacts to `deployed`."""
    reacting = world.structure.lift(deployed)

    def one(key: Array) -> tuple[Array, Array, Array, Array]:
        drawn = draw_path(world, reacting, key)

        def gradient(M: Array) -> tuple[Array, Array]:
            path = run_path(world, world.structure.lift(M), *drawn)
            return path_gradient(world, path).reshape(-1), jnp.sum(world.cost.path_cost(path.x, path.u))

        slope, push, cost = jax.linearize(gradient, M, has_aux=True)
        directions = jnp.eye(M.size, dtype=M.dtype).reshape(-1, *M.shape)
        return cost, slope, jax.vmap(push)(directions), jnp.outer(slope, slope)

    square = jnp.zeros((M.size, M.size), M.dtype)
    cost, slope, hessian, second = average(world, one, (square[0, 0], square[0], square, square))
    return Averages(cost, slope.reshape(M.shape), (hessian + hessian.T) / 2, second - jnp.outer(slope, slope))


@program(whole=True)
def reaction(world: Sampled, M: Any, deployed: Any) -> Array:
    """∂_2 of the mean gradient at M, (p, p): how the paths, and with them the gradient, move with `deployed`."""
    policy = world.structure.lift(M)

    def one(key: Array) -> Array:
        def gradient(deployed: Array) -> Array:
            reacting = world.structure.lift(deployed)
            x0, w, draws = draw_path(world, reacting, key)
            slope = path_gradient(world, run_path(world, policy, x0, w, draws)).reshape(-1)
            log_probability = world.perturbation.log_probability(draws, reacting, world.horizon)
            if log_probability is None:
                return slope
            # One in value; its derivative is the score.
            return slope * jnp.exp(log_probability - jax.lax.stop_gradient(log_probability))

        return jax.jacfwd(gradient)(deployed).reshape(M.size, M.size)

    return average(world, one, jnp.zeros((M.size, M.size), M.dtype))


def _model(world: Sampled, at: Averages, M: Any, damping: Any = 0) -> Affine | Projected:
    """The quadratic model of the mean cost about M, its curvature raised by `damping`, and the way to minimise it."""
    xp, _ = numerics(at, M)
    matrix = at.hessian + xp.asarray(damping, M.dtype) * xp.eye(M.size, dtype=M.dtype)
    linear = at.gradient - (matrix @ M.reshape(-1)).reshape(M.shape)
    step = 1 / xp.maximum(xp.linalg.eigvalsh(matrix)[-1], xp.finfo(M.dtype).tiny)
    return (Affine if world.feasible_set.affine else Projected)(world.feasible_set, Quadratic(linear, step, matrix))


def _finite(at: Averages) -> Any:
    xp, _ = numerics(at)
    return xp.isfinite(at.cost) & xp.all(xp.isfinite(at.gradient)) & xp.all(xp.isfinite(at.hessian))


def minimise(world: Sampled, deployed: Any, start: Any) -> tuple[Any, Any]:
    """Φ_N(deployed), NaN where the paths overflow, and whether it is the only minimiser; carries no derivative."""
    xp, _ = numerics(world, deployed, start)
    precision = xp.finfo(start.dtype).eps
    M = nearest(world.feasible_set, start)
    at = averages(world, M, deployed)
    sound = _finite(at)
    if known(sound) and not sound:
        return xp.full_like(start, xp.nan), xp.asarray(False)

    def curvature(at: Averages) -> Any:
        return xp.trace(at.hessian) / start.size + xp.finfo(start.dtype).tiny

    def lookout(M: Any, at: Averages, damping: Any) -> tuple[Any, Any]:
        """Where the model leads, and how far that is relative to the policies that it knows."""
        model = _model(world, at, M, damping)
        ahead, _ = model.minimise(M)
        scale = frobenius(ahead) + frobenius(model.form.step * model.form.linear)
        return ahead, frobenius(ahead - M) / xp.where(scale > 0, scale, 1)

    def improve(carry: Any) -> Any:
        M, at, damping, ahead, _, count = carry
        there = averages(world, ahead, deployed)
        promised = xp.sum(at.gradient * (ahead - M))
        # Where the decrease is below the rounding of the cost, the model is trusted.
        allowed = at.cost + ARMIJO * promised + 100 * precision * xp.abs(at.cost)
        good = (there.cost <= allowed) & _finite(there)
        lighter = xp.maximum(damping / 10, 1e-10 * curvature(at))
        heavier = xp.maximum(10 * damping, 1e-3 * curvature(at))
        damping = xp.where(good, lighter, heavier).astype(M.dtype)
        M, at = choose(good, (ahead, there), (M, at))
        return M, at, damping, *lookout(M, at, damping), count + 1

    def unfinished(carry: Any) -> Any:
        *_, distance, count = carry
        return (distance > xp.sqrt(precision)) & (count < NEWTON_STEPS)

    damping = xp.asarray(1e-10 * curvature(at), M.dtype)
    M, at, *_ = while_loop(unfinished, improve, (M, at, damping, *lookout(M, at, damping), xp.asarray(0)))
    unique = _model(world, at, M).minimise(M)[1]
    return xp.where(sound, M, xp.nan), unique


def approach(world: Sampled, deployed: Any, start: Any, count: int) -> Any:
    """`count` projected gradient steps towards Φ_N(deployed) from `start`, NaN where the paths overflow.

    A step is 1/‖Hessian‖ long, halved until the cost falls below the quadratic bound that this length stands for.
    """
    xp, _ = numerics(world, deployed, start)
    precision, tiny = xp.finfo(start.dtype).eps, xp.finfo(start.dtype).tiny

    def longest(at: Averages) -> Any:
        return 1 / xp.maximum(xp.linalg.eigvalsh(at.hessian)[-1], tiny)

    def advance(carry: Any) -> Any:
        M, at, step, taken, tried = carry
        ahead = nearest(world.feasible_set, M - step * at.gradient)
        there = averages(world, ahead, deployed)
        moved = ahead - M
        bound = at.cost + xp.sum(at.gradient * moved) + xp.sum(moved**2) / (2 * step)
        good = _finite(there) & (there.cost <= bound + 100 * precision * xp.abs(at.cost))
        M, at = choose(good, (ahead, there), (M, at))
        return M, at, xp.where(good, longest(at), step / 2), taken + good, tried + 1

    def unfinished(carry: Any) -> Any:
        *_, taken, tried = carry
        return (taken < count) & (tried < count + NEWTON_STEPS)

    M = nearest(world.feasible_set, start)
    at = averages(world, M, deployed)
    sound = _finite(at)
    if known(sound) and not sound:
        return xp.full_like(start, xp.nan)
    zero = xp.asarray(0)
    M, *_ = while_loop(unfinished, advance, (M, at, longest(at), zero, zero))
    return xp.where(sound, M, xp.nan)


def sampled_jacobian(world: Sampled, deployed: Any, response: Any) -> Any:
    """Φ_N'(deployed), (p, p), given Φ_N(deployed), by the implicit function theorem."""
    model = _model(world, averages(world, response, deployed), response)
    return model.jacobian(response, reaction(world, response, deployed))


def sampled_residual(world: Sampled, M: Any, deployed: Any) -> Any:
    """The relative natural residual of the mean cost, with its Hessian at M; infinite where the paths overflow."""
    xp, _ = numerics(world, M, deployed)
    at = averages(world, M, deployed)
    if known(at.cost) and not _finite(at):
        return xp.asarray(xp.inf, M.dtype)
    form = _model(world, at, M).form
    moved = frobenius(M - nearest(world.feasible_set, M - form.step * at.gradient))
    scale = frobenius(M) + frobenius(form.step * form.linear)
    return xp.where(_finite(at), moved / xp.where(scale > 0, scale, 1), xp.inf)


class Uncertainty(NamedTuple):
    """Of a sampled policy: standard errors, policy_shape, and the radius of its ball of 95 % confidence."""

    standard_error: Any
    radius: Any

    @property
    def total(self) -> Any:
        """The root mean square of the policy's error in the Frobenius norm."""
        return frobenius(self.standard_error)


def uncertainty(world: Sampled, M: Any, deployed: Any = None) -> Uncertainty:
    """That of a best response to `deployed`; without it that of a stable policy, which its own reaction amplifies.

    A fixed point moves by (I - Φ')⁻¹ times what the best response moves.
    """
    xp, _ = numerics(world, M, deployed)
    reacting = M if deployed is None else deployed
    at = averages(world, M, reacting)
    model = _model(world, at, M)
    values, vectors = xp.linalg.eigh(at.covariance)
    root = vectors * xp.sqrt(xp.maximum(values, 0) / xp.asarray(world.samples, M.dtype))
    factor = model.jacobian(M, root)
    if deployed is None:
        slope = model.jacobian(M, reaction(world, M, reacting))
        factor = solve(xp.eye(M.size, dtype=M.dtype) - slope, factor)
    return spread(factor, M)


def spread(factor: Any, M: Any) -> Uncertainty:
    """The uncertainty of a policy M whose covariance is factor factorᵀ, factor (p, p).

    The radius takes ‖error‖² for a multiple of a χ² of the same mean and variance (Satterthwaite), with the quantile
    of Wilson and Hilferty.
    """
    xp, _ = numerics(factor)
    covariance = factor @ factor.T
    trace, square = xp.trace(covariance), xp.sum(covariance**2)
    trace_or_one = xp.where(trace > 0, trace, 1)
    freedom = xp.where(square > 0, trace_or_one**2 / xp.where(square > 0, square, 1), 1)
    ninth = 2 / (9 * freedom)
    radius = xp.sqrt(trace * (1 - ninth + QUANTILE * xp.sqrt(ninth)) ** 3)
    return Uncertainty(xp.sqrt(xp.diagonal(covariance)).reshape(M.shape), radius)
