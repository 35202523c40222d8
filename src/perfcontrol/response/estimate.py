"""The best response of any convex cost, from as many samples as its tolerance asks for."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import check_finite, check_instance, check_integer, check_key, check_tolerance, fail
from perfcontrol._linalg import frobenius
from perfcontrol._programs import known, numerics, on_host
from perfcontrol.costs import ConvexCost, QuadraticCost
from perfcontrol.evaluate.estimate import Estimate
from perfcontrol.evaluate.rollout import simulate
from perfcontrol.problem import PerformativeProblem, check_end, check_problem
from perfcontrol.response.quadratic import DENSE_LIMIT
from perfcontrol.response.sampled import Sampled, Uncertainty, minimise, uncertainty

TOLERANCE = 1e-2  # of sampled policies, unless told otherwise
LOOKED_AT = 16  # paths on which convexity is checked


class SampleAverage(eqx.Module):
    """How many paths a sampled answer may use: grown until its standard error meets the tolerance.

    The paths of a smaller sample are the first ones of a larger sample. Under jit and vmap best responses keep to
    `samples`.

    Args:
        samples: paths to begin with.
        limit: paths at most.

    Raises:
        InputError: fewer than two paths, a limit below them.
    """

    samples: int = eqx.field(static=True)
    limit: int = eqx.field(static=True)

    def __init__(self, samples: int = 1024, limit: int = 2**18):
        self.samples = check_integer("samples", samples, 2)
        self.limit = check_integer("limit", limit, self.samples)

    def following(self, samples: Any, excess: Any) -> Any:
        """The next sample size where the standard error is `excess` times too large: by doubling, as often as needed.

        The standard error falls like 1/√N.
        """
        xp, _ = numerics(samples, excess)
        doublings = xp.clip(xp.ceil(2 * xp.log2(1.05 * excess)), 1, 30)
        return xp.asarray(xp.minimum(samples * 2.0**doublings, self.limit), samples.dtype)


def as_sampling(value: Any) -> SampleAverage:
    """`value` itself; the default for None."""
    return SampleAverage() if value is None else check_instance("sampling", value, SampleAverage, "pc.SampleAverage()")


def is_exact(problem: PerformativeProblem) -> bool:
    """Whether best responses can be had without sampling."""
    if not isinstance(problem.cost, QuadraticCost):
        return False
    policy = jax.ShapeDtypeStruct(problem.lifted_shape, problem.dtype)
    spread = eqx.filter_eval_shape(lambda law, M: law.covariance(M, problem.steps), problem.perturbation, policy)
    return spread is not None


def check_sampling(problem: PerformativeProblem, tolerance: float | None) -> None:
    """Raise where sampled best responses cannot be had: not convex (on samples), or too large."""
    check_end(problem)
    check_tolerance(TOLERANCE if tolerance is None else tolerance, problem.dtype)
    size = math.prod(problem.policy_shape)
    if size > DENSE_LIMIT:
        required = f"have at most {DENSE_LIMIT} where best responses are sampled"
        raise fail("problem", f"{size} free parameters", required, "Use pc.RSGD.")
    if isinstance(problem.cost, ConvexCost):
        paths = simulate(problem, problem.initial_policy(), key=jax.random.key(0), samples=LOOKED_AT)
        if known(paths.x, paths.u):
            problem.cost.check_convexity(paths.x, paths.u)


def excess(error: Uncertainty, M: Any, tolerance: float | None) -> Any:
    """The standard error over what the tolerance allows, `tolerance`·‖M‖."""
    return error.total / ((TOLERANCE if tolerance is None else tolerance) * frobenius(M))


def estimate_response(
    problem: PerformativeProblem,
    deployed: Any,
    *,
    key: Any = None,
    tolerance: float | None = None,
    sampling: SampleAverage | None = None,
) -> Estimate:
    """Φ(deployed) by sample-average approximation, with its standard error; for any convex cost, without moments.

    Minimises the mean cost of N paths that the deployed policy has made, N grown until the root mean square error
    (delta method) is at most `tolerance`·‖Φ‖. Its bias is of order 1/N, its standard error of order 1/√N.

    Args:
        problem: with any convex cost and perturbation.
        deployed: free policy parameters that the world reacts to.
        key: JAX random key; required.
        tolerance: relative standard error; None for 0.01.
        sampling: how many paths; None for `SampleAverage()`.

    Returns:
        mean and standard_error, each of shape `problem.policy_shape`.

    Raises:
        InputError: wrong shapes, a missing key, a cost that is not convex at points of simulated paths, a limit of
            samples at which the tolerance is not met.

    References:
        Shapiro, Dentcheva and Ruszczyński, Lectures on Stochastic Programming, chapter 5.
    """
    deployed, key = check_problem(problem).check_policy("deployed", deployed), check_key(key)
    sampling = as_sampling(sampling)
    check_sampling(problem, tolerance)
    if not known(problem, deployed, key):
        world = Sampled(problem, key, jnp.asarray(sampling.samples))
        M, _ = minimise(world, deployed, deployed)
        return Estimate(M, uncertainty(world, M, deployed).standard_error)
    M, deployed, samples = on_host(deployed), on_host(deployed), np.asarray(sampling.samples)
    with np.errstate(all="ignore"):
        while True:
            world = Sampled(problem, key, samples)
            M, _ = minimise(world, deployed, M)
            check_finite("the best response", M)
            error = uncertainty(world, M, deployed)
            over = excess(error, M, tolerance)
            if over <= 1 or error.total == 0:
                return Estimate(jnp.asarray(M), jnp.asarray(error.standard_error))
            if samples >= sampling.limit:
                got = f"{sampling.limit}, where the standard error is {float(over):.3g} times what the tolerance allows"
                remedy = "Raise `tolerance`, or pass sampling=pc.SampleAverage(limit=...)."
                raise fail("sampling.limit", got, "be as many paths as the tolerance needs", remedy)
            samples = sampling.following(samples, over)
