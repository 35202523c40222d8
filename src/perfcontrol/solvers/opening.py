"""The first steps towards a stable point in one program, for the plainest problems: there it compiles quickly.

Neither constraint nor structure, noise of mean zero and constant covariance. Then Φ = -G⁻¹F with the impulse form of
the world, and nothing but that form varies from step to step.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jaxtyping import Array

from perfcontrol._linalg import frobenius
from perfcontrol._programs import known, numerics, program
from perfcontrol.evaluate.impulses import impulse_form
from perfcontrol.evaluate.world import world_of
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import Response
from perfcontrol.response.methods import is_free, is_held
from perfcontrol.response.quadratic import Factors
from perfcontrol.response.respond import moved_by
from perfcontrol.response.separable import Separable

STEPS = 14  # enough where each shrinks the gap tenfold


class Opening(NamedTuple):
    """What the first steps met.

    policies: (k, *policy_shape), the first one M_0. images: Φ of them, likewise. gaps: ‖Φ(M) - M‖, (k,). response: to
    the last.
    """

    policies: Any
    images: Any
    gaps: Any
    response: Response


def secant_direction(M: Any, image: Any, before: Any, image_before: Any) -> Any:
    """To Φ(M), as corrected by what the last step showed: Anderson's method with one difference."""
    gap, xp = image - M, numerics(M, image)[0]
    change = gap - (image_before - before)
    squared = xp.sum(change**2)
    share = xp.sum(change * gap) / xp.where(squared > 0, squared, 1)
    return gap - share * (image - image_before)


def opened(problem: Any, M0: Any, contracting: float, enough: float, count: int) -> Opening | None:
    """At most `count` steps: as long as each multiplies the gap by `contracting` at most, until it is `enough` ‖M‖.

    None where the problem is not of that kind, or the last Hessian not regular.
    """
    if not isinstance(problem, PerformativeProblem) or problem.noise_reacts or not known(problem):
        return None
    if not (is_free(problem) and is_held(problem)):
        return None
    mean, Sigma = _moments(problem.noise)
    if np.any(mean) or Sigma.ndim == 3:
        return None
    limits = np.asarray([contracting, enough], M0.dtype)
    steps, policies, images, gaps, (F, G) = _contract(problem, M0, limits, np.asarray(min(count, STEPS)))
    M, image = policies[steps - 1], images[steps - 1]
    if not (np.all(np.isfinite(G)) and np.all(np.isfinite(image))):
        return None
    form = Factors(2 * (F @ Sigma).reshape(M0.shape), G, None, Sigma, None)
    method = Separable(form, lambda: None)
    if not method.regular:
        return None
    response = Response(image, method.regular, moved_by(problem, form, method.step, M, form.gradient(M)))
    return Opening(policies[:steps], images[:steps], gaps[:steps], response)


_moments = program(lambda noise: (noise.mean, noise.covariance))


@program
def _contract(problem: PerformativeProblem, M0: Any, limits: Any, count: Any) -> Any:
    """How many steps, their policies, images and gaps, and the last F and G."""

    def respond(M: Array) -> tuple[Array, tuple[Array, Array]]:
        form = impulse_form(world_of(problem, M), problem.memory)
        factor = jax.scipy.linalg.cho_factor(form.G, lower=True)
        image = -jax.scipy.linalg.cho_solve(factor, form.F)
        image = image - jax.scipy.linalg.cho_solve(factor, form.F + form.G @ image)  # iterative refinement
        return image.reshape(M.shape), (form.F, form.G)

    def unfinished(carry: Any) -> Array:
        step, policies, _, gaps, _ = carry
        shrunk = (step == 1) | (gaps[step - 1] <= limits[0] * gaps[step - 2])
        far = gaps[step - 1] > limits[1] * frobenius(policies[step - 1])
        return (step == 0) | ((step < count) & shrunk & far)

    def advance(carry: Any) -> Any:
        step, policies, images, gaps, _ = carry
        last, before = jnp.maximum(step - 1, 0), jnp.maximum(step - 2, 0)
        M = policies[last] + secant_direction(policies[last], images[last], policies[before], images[before])
        image, form = respond(M)
        gap = frobenius(image - M)
        return step + 1, policies.at[step].set(M), images.at[step].set(image), gaps.at[step].set(gap), form

    rows = jnp.zeros((STEPS, *M0.shape), M0.dtype).at[0].set(M0)  # no direction yet at the first step
    rank, n = problem.memory * problem.input_size, problem.state_size
    form = jnp.zeros((rank, n), M0.dtype), jnp.zeros((rank, rank), M0.dtype)
    return jax.lax.while_loop(unfinished, advance, (jnp.asarray(0), rows, rows, jnp.zeros(STEPS, M0.dtype), form))
