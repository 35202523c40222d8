"""The cost of a policy, estimated from simulated paths."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from perfcontrol._programs import program
from perfcontrol.evaluate.by_kernel import by_kernel
from perfcontrol.evaluate.paths import over_paths
from perfcontrol.evaluate.rollout import check_paths, sample_along
from perfcontrol.problem import PerformativeProblem


class Estimate(eqx.Module):
    """A sample mean with its standard error.

    Attributes:
        mean: any shape.
        standard_error: the same shape.
    """

    mean: Float[Array, "..."]
    standard_error: Float[Array, "..."]


def _path_cost(problem: PerformativeProblem, policy: Array, deployed: Array, key: Key[Array, ""]) -> Array:
    path = sample_along(problem, policy, deployed, key)
    return jnp.sum(problem.cost.path_cost(path.x, path.u))


@program(on_device=True)
def _path_costs(
    problem: PerformativeProblem, M: Array, deployed: Array, key: Array, samples: int, devices: int
) -> Array:
    policy, reacting = problem.structure.lift(M), problem.structure.lift(deployed)

    def one(key: Array) -> Array:
        return by_kernel(_path_cost, problem, policy, reacting, key, gradient=False)

    return over_paths(problem, one, key, samples, along=True, devices=devices)


def estimate_cost(
    problem: PerformativeProblem,
    M: Any,
    *,
    deployed: Any = None,
    key: Any = None,
    samples: int = 1024,
    truncation: int | None = None,
) -> Estimate:
    """Monte Carlo estimate of C_T(M; deployed) with its standard error; needs no moments and any cost.

    On an infinite horizon of the average cost per stage over `truncation` steps, x_0 included: its bias, of the order
    1/truncation, is not in the standard error.

    Args:
        problem: the problem.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise, the policy that the world reacts to; None for M itself.
        key: JAX random key; required.
        samples: number of paths.
        truncation: T of the paths, for an infinite horizon and only there.

    Raises:
        InputError: as `simulate`; at least two samples are needed for a standard error.
    """
    asked = check_paths(problem, M, deployed, key, samples, truncation, least=2)
    costs = asked.weight * _path_costs(*asked.arguments)
    return Estimate(jnp.mean(costs), jnp.std(costs, ddof=1) / jnp.sqrt(asked.samples))
