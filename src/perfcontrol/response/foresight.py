"""What policies cost in the worlds that they make themselves, by sample averages, and its total derivative.

Draws that move with the deployed policy are differentiated as they move (common random numbers). Draws that stay put
while their probabilities move (`log_probability`) are made by one policy, the reference, and weighed:
    C_N(M) = Σ_s W_s(M) J_s(M) / Σ_s W_s(M),    W_s(M) = p(draws_s | M) / p(draws_s | reference),
whose derivative at the reference is the score function's. Both are smooth functions of M for a fixed key.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._linalg import solve, symmetrise
from perfcontrol._programs import Numbers, numerics, program
from perfcontrol.evaluate.rollout import draw_path, run_path
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response.projected import projection_slope
from perfcontrol.response.sampled import Sampled, Uncertainty, average, averages, spread


class Foreseen(Sampled):
    """A problem whose expectations are means over paths, deployed and evaluated policy being the same."""

    reference: Numbers  # policy_shape: makes the draws whose probabilities are known

    def __init__(self, problem: PerformativeProblem, key: Key[Array, ""], samples: Any, reference: Any):
        super().__init__(problem, key, samples)
        self.reference = reference

    @property
    def weighed(self) -> bool:
        """Whether draws stay put and are weighed (known from shapes)."""
        lifted = self.structure.lift(jnp.zeros(self.policy_shape, self.dtype))

        def log_probability(M: Array) -> Any:
            draws = self.perturbation.sample(jax.random.key(0), M, self.horizon)
            return self.perturbation.log_probability(draws, M, self.horizon)

        return jax.eval_shape(log_probability, lifted) is not None


def _weighed_cost(world: Foreseen, M: Array, key: Array) -> tuple[Array, Array]:
    """W J and W of one path."""
    policy, reference = world.structure.lift(M), world.structure.lift(world.reference)
    x0, w, draws = draw_path(world, policy, key)
    weight = jnp.ones((), M.dtype)
    if world.weighed:
        draws = draw_path(world, reference, key)[2]
        there, here = (world.perturbation.log_probability(draws, at, world.horizon) for at in (policy, reference))
        assert there is not None and here is not None
        weight = jnp.exp(there - here)
    path = run_path(world, policy, x0, w, draws)
    return weight * jnp.sum(world.cost.path_cost(path.x, path.u)), weight


@program(whole=True)
def values_and_gradients(world: Foreseen, policies: Any) -> tuple[Array, Array]:
    """C_N and its total derivative at policies stacked along the first axis."""

    def one(key: Array) -> tuple[Array, ...]:
        def both(M: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
            values, pull = jax.vjp(lambda M: jnp.stack(_weighed_cost(world, M, key)), M)
            by_cost, by_weight = (pull(unit)[0] for unit in jnp.eye(2, dtype=values.dtype))
            return (values[0], values[1]), (by_cost, by_weight)

        (cost, weight), (by_cost, by_weight) = jax.vmap(both)(policies)
        return cost, weight, by_cost, by_weight

    numbers = jnp.zeros(len(policies), policies.dtype)
    cost, weight, by_cost, by_weight = average(world, one, (numbers, numbers, policies, policies))
    value = cost / weight
    wide = (slice(None), *[None] * (policies.ndim - 1))
    return value, (by_cost - value[wide] * by_weight) / weight[wide]


def value_and_gradient(world: Foreseen, M: Any) -> tuple[Any, Any]:
    """The same at one policy."""
    values, gradients = values_and_gradients(world, M[None])
    return values[0], gradients[0]


@program(whole=True)
def curvature(world: Foreseen, M: Any) -> tuple[Array, Array]:
    """The total Hessian of C_N (p, p), and the covariance (p, p) of what single paths add to its gradient."""
    value, slope_there = value_and_gradient(world, M)
    gradient = slope_there.reshape(-1)

    def one(key: Array) -> tuple[Array, Array, Array, Array]:
        def influence(M: Array) -> Array:
            cost, weight = _weighed_cost(world, M, key)
            return cost - value * weight

        def slope(M: Array) -> Array:
            return jax.grad(influence)(M).reshape(-1)

        weight, by_weight = jax.value_and_grad(lambda M: _weighed_cost(world, M, key)[1])(M)
        apart = slope(M) - weight * gradient
        return jax.jacfwd(slope)(M).reshape(M.size, M.size), jnp.outer(apart, apart), by_weight.reshape(-1), weight

    square = jnp.zeros((M.size, M.size), M.dtype)
    bend, covariance, by_weight, weight = average(world, one, (square, square, square[0], square[0, 0]))
    # The derivative of a ratio: also the weights' sum moves.
    crossed = jnp.outer(gradient, by_weight)
    return symmetrise((bend - crossed - crossed.T) / weight), covariance / weight**2


def step_of(world: Foreseen, M: Any) -> Any:
    """1/‖Hessian of the mean cost in the world that M makes‖."""
    xp, _ = numerics(world, M)
    matrix = averages(world, M, M).hessian
    return 1 / xp.maximum(xp.linalg.eigvalsh(matrix)[-1], xp.finfo(M.dtype).tiny)


def uncertainty(world: Foreseen, M: Any) -> Uncertainty:
    """Of the policy that minimises C_N: by the delta method through the total Hessian, on the face that M lies on."""
    xp, _ = numerics(world, M)
    hessian, covariance = curvature(world, M)
    step = step_of(world, M)
    slope = projection_slope(world.feasible_set, M - step * value_and_gradient(world, M)[1])
    eye = xp.eye(M.size, dtype=M.dtype)
    system = eye - slope @ (eye - step * hessian)
    values, vectors = xp.linalg.eigh(covariance)
    root = vectors * xp.sqrt(xp.maximum(values, 0) / xp.asarray(world.samples, M.dtype))
    return spread(solve(system, step * slope @ root), M)
