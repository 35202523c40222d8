"""The cost as a quadratic form 𝔾(θ) of the policy at given variances θ of fixed directions, and its derivative in θ."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.exact import exact_cost, exact_gradient
from perfcontrol.perturbations import AbstractPerturbation, CovarianceOperator, DirectionalPerturbation, Draws
from perfcontrol.perturbations.directional import DirectionalCovariance
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import Constant
from perfcontrol.response import respond
from perfcontrol.theory.derivatives import fixed_noise


class _GivenVariances(AbstractPerturbation):
    """Fixed directions whose variances are given and differentiable, whatever the policy; never sampled."""

    directions: Array
    variances: Array
    mean_value: Array

    def columns(self, state_size: int, input_size: int) -> int:
        return self.directions.shape[-1]

    def sample(self, key: Any, M: Array, horizon: int) -> Draws:
        raise NotImplementedError

    def mean(self, M: Array, horizon: int) -> Array:
        return self.mean_value

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        return DirectionalCovariance(self.variances, self.directions)

    def bound(self, feasible_set: Any, horizon: int) -> None:
        return None

    def sensitivity(self, feasible_set: Any, horizon: int) -> None:
        return None


def _with_variances(problem: PerformativeProblem, variances: Array) -> PerformativeProblem:
    law = problem.perturbation
    assert isinstance(law, DirectionalPerturbation)
    mean = law.mean(problem.structure.lift(problem.initial_policy()), problem.horizon)
    return eqx.tree_at(lambda p: p.perturbation, problem, _GivenVariances(law.directions, variances, mean))


@eqx.filter_jit
def form_at(problem: PerformativeProblem, basis: Array, variances: Array) -> Array:
    """𝔾(θ): the cost as [1; y]ᵀ𝔾[1; y] at the policies base + basis y, (1+q, 1+q)."""
    given = _with_variances(problem, variances)
    base = problem.initial_policy()
    gradient = exact_gradient(given, base, base).reshape(-1)

    def column(direction: Array) -> Array:
        return exact_gradient(given, base + direction.reshape(base.shape), base).reshape(-1) - gradient

    curvature = basis.T @ jax.lax.map(column, basis.T, batch_size=16).T
    half = basis.T @ gradient / 2
    top = jnp.concatenate([exact_cost(given, base, base)[None], half])
    return jnp.concatenate([top[None], jnp.concatenate([half[:, None], (curvature + curvature.T) / 4], axis=1)])


@eqx.filter_jit
def form_derivative(problem: PerformativeProblem, basis: Array, variances: Array, along: Array) -> Array:
    """d𝔾(θ)/dθ along a direction, (1+q, 1+q)."""
    return jax.jvp(lambda theta: form_at(problem, basis, theta), (variances,), (along,))[1]


@eqx.filter_jit
def least_cost(problem: PerformativeProblem, variances: Array) -> Array:
    """The smallest cost on the set at given variances."""
    given, start = _with_variances(problem, variances), problem.initial_policy()
    return exact_cost(given, respond(given, start).M, start)


def simplified(problem: PerformativeProblem) -> PerformativeProblem:
    """Without what does not enter the gradient for zero-mean noise: the initial state and the targets."""
    if float(jnp.max(jnp.abs(fixed_noise(problem).mean))) > 0:
        return problem
    cost = problem.cost
    assert isinstance(cost, QuadraticCost)
    zero = Constant(jnp.zeros(problem.state_size, problem.dtype))
    untargeted = QuadraticCost(cost.Q, cost.R, cost.cross, discount=cost.discount)
    return eqx.tree_at(lambda p: (p.initial_state, p.cost), problem, (zero, untargeted))
