"""Which scalars the scales of a problem depend on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol.perturbations import DirectionalPerturbation
from perfcontrol.policy_maps import Norm
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.facts import in_free_parameters
from perfcontrol.theory.optimality.distance import Distance
from perfcontrol.theory.optimality.linear import Linear
from perfcontrol.theory.optimality.scalars import AbstractScalars
from perfcontrol.theory.optimality.sizes import Sizes

MOST = 3  # scalars: the number of cells grows like a power of it

FEWER = "pass scale=pc.Affine(offset, slope) with parallel slopes, or scale=pc.Norm(offset, weight)"
GENERAL = (
    "the scales are a general function: pass scale=pc.Affine(offset, slope) or scale=pc.Norm(offset, weight), or "
    "declare that its sublevel sets are convex by scale=pc.Function(f, convex=True)"
)


def scalars_of(problem: PerformativeProblem) -> AbstractScalars | str:
    """What the scales depend on, or why that is not known to be simple enough."""
    law = problem.perturbation
    assert isinstance(law, DirectionalPerturbation)
    shape, scale = (problem.horizon, law.directions.shape[0]), law.scale
    policy = jax.ShapeDtypeStruct(problem.lifted_shape, problem.dtype)
    if isinstance(scale, Norm):
        return Distance.of(problem, scale, shape)
    derivative = scale.derivative()
    if scale.constant or derivative is not None:
        size = int(np.prod(problem.policy_shape))
        slopes = np.zeros((1, 1, size)) if derivative is None else in_free_parameters(problem, derivative).astype(float)
        origin = np.asarray(scale(jnp.zeros(problem.lifted_shape, problem.dtype)), dtype=float)
        linear = Linear(problem, np.broadcast_to(origin, shape), np.broadcast_to(slopes, (*shape, size)))
        if len(linear.low) > MOST:
            return f"the scales depend on {len(linear.low)} linear functions of the policy, more than {MOST}: " + FEWER
        return linear
    if scale.convex:
        values = eqx.filter_eval_shape(scale, policy).shape
        if len(values) == 1 and values[0] <= MOST:
            return Sizes(problem, values[0])
        return f"the scales have values of shape {values}: pass a function with values (k,), k ≤ {MOST}, for all times"
    return GENERAL
