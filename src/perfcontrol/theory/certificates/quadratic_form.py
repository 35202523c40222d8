"""The cost as a quadratic form 𝔾(θ) of the policy at given variances θ of fixed directions, and its derivative in θ."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._linalg import Matrix
from perfcontrol._programs import program
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.cost_to_go import CostToGo, cost_to_go
from perfcontrol.evaluate.exact import weigh
from perfcontrol.perturbations import AbstractPerturbation, CovarianceOperator, DirectionalPerturbation, Draws
from perfcontrol.perturbations.directional import DirectionalCovariance
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import Constant
from perfcontrol.response import response_hessian
from perfcontrol.response.affine import Affine
from perfcontrol.response.projected import Projected
from perfcontrol.response.quadratic import Quadratic
from perfcontrol.theory.facts import facts, nearest_to_zero


class GivenMoments(AbstractPerturbation):
    """A law of given mean and covariance, whatever the policy; never sampled."""

    mean_value: Matrix | None  # None for zero
    spread: CovarianceOperator
    width: int = eqx.field(static=True)  # columns of Δ

    def columns(self, state_size: int, input_size: int) -> int:
        return self.width

    def sample(self, key: Any, M: Array, horizon: int) -> Draws:
        raise NotImplementedError

    def mean(self, M: Array, horizon: int) -> Array:
        raise NotImplementedError

    def mean_operator(self, M: Array, horizon: int) -> Matrix | None:
        return self.mean_value

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        return self.spread

    def bound(self, feasible_set: Any, horizon: int) -> None:
        return None

    def sensitivity(self, feasible_set: Any, horizon: int) -> None:
        return None


class Expansion(NamedTuple):
    """C(M) = cost + <gradient, M - base> + <M - base, hessian (M - base)>/2 in the free parameters."""

    cost: Any
    gradient: Any  # (p,)
    hessian: Any  # (p, p)

    def form(self, basis: np.ndarray) -> np.ndarray:
        """𝔾, (1+q, 1+q): the cost as [1; y]ᵀ𝔾[1; y] at the policies base + basis y."""
        half = basis.T @ self.gradient / 2
        curvature = basis.T @ self.hessian @ basis / 2
        return np.block([[np.reshape(self.cost, (1, 1)), half[None]], [half[:, None], (curvature + curvature.T) / 2]])

    def least(self, problem: PerformativeProblem) -> float:
        """The smallest value on the feasible set."""
        base, step = nearest_to_zero(problem), 1 / np.linalg.norm(self.hessian, 2)
        linear = (self.gradient - self.hessian @ base.reshape(-1)).reshape(base.shape)
        method = Affine if problem.feasible_set.affine else Projected
        M, _ = method(problem.feasible_set, Quadratic(linear, step, self.hessian)).minimise(base)
        moved = (M - base).reshape(-1)
        return float(self.cost + self.gradient @ moved + moved @ self.hessian @ moved / 2)


@program
def _worlds(problem: PerformativeProblem, base: Any, variances: Any, along: Any) -> tuple[CostToGo, CostToGo]:
    """The cost-to-go at given variances, and its derivative in them, with everything else as it is."""
    law, lifted = problem.perturbation, problem.structure.lift(base)
    assert isinstance(law, DirectionalPerturbation)
    mean = law.mean_operator(lifted, problem.horizon)

    def at(variances: Array) -> CostToGo:
        fixed = GivenMoments(mean, DirectionalCovariance(variances, law.directions), law.directions.shape[-1])
        return cost_to_go(eqx.tree_at(lambda p: p.perturbation, problem, fixed), lifted)

    world, derivative = jax.jvp(at, (variances,), (along,))
    kept = (world.F, world.B, world.noise_mean, world.noise_covariance)
    return world, eqx.tree_at(lambda w: (w.F, w.B, w.noise_mean, w.noise_covariance), derivative, kept)


def expand(problem: PerformativeProblem, base: np.ndarray, world: CostToGo) -> Expansion:
    """The cost about `base` in a given world."""
    cost, gradient = weigh(problem, world, base)
    return Expansion(cost, gradient.reshape(-1), response_hessian(problem, world))


def expansion(problem: PerformativeProblem, variances: np.ndarray) -> Expansion:
    """The cost about the policy nearest to zero at given variances (T, k)."""
    base, theta = nearest_to_zero(problem), variances.astype(problem.dtype)
    return expand(problem, base, _worlds(problem, base, theta, np.zeros_like(theta))[0])


def expansions(problem: PerformativeProblem, variances: np.ndarray, along: np.ndarray) -> tuple[Expansion, Expansion]:
    """The same, and its derivative in the variances along (T, k).

    Given the mean dynamics, an expansion is affine in the cost-to-go Λ and in the weights R and N: its derivative is
    the expansion of their derivatives, less that of zeros.
    """
    base, dtype = nearest_to_zero(problem), problem.dtype
    world, derivative = _worlds(problem, base, variances.astype(dtype), along.astype(dtype))
    zeros = eqx.tree_at(
        lambda w: (w.first, w.Lambda, w.R, w.N),
        derivative,
        replace_fn=lambda leaf: None if leaf is None else np.zeros_like(leaf),
        is_leaf=lambda leaf: leaf is None,
    )
    slope, rest = expand(problem, base, derivative), expand(problem, base, zeros)
    return expand(problem, base, world), Expansion(*(one - other for one, other in zip(slope, rest, strict=True)))


def simplified(problem: PerformativeProblem) -> PerformativeProblem:
    """Without what does not enter the gradient for zero-mean noise: the initial state and the targets."""
    if facts(problem).noise_has_mean:
        return problem
    cost = problem.cost
    assert isinstance(cost, QuadraticCost)
    zero = Constant(jnp.zeros(problem.state_size, problem.dtype))
    untargeted = QuadraticCost(cost.Q, cost.R, cost.cross, discount=cost.discount)
    return eqx.tree_at(lambda p: (p.initial_state, p.cost), problem, (zero, untargeted))
