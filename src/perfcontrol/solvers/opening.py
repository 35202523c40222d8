"""The first steps towards a stable point in one program, where a best response is one solve: there it compiles quickly.

Without constraint, structure and mean noise Φ = -G⁻¹F with the impulse form of the world. On an affine set
Φ = o - A⁻¹P g(o) with its point o nearest to zero, the orthogonal projection P onto the directions that keep it, and
A = P𝐇P + h(I-P) for some h > 0.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jaxtyping import Array

from perfcontrol._linalg import frobenius
from perfcontrol._programs import known, numerics, program
from perfcontrol.evaluate.exact import weigh
from perfcontrol.evaluate.impulses import impulse_form
from perfcontrol.evaluate.world import world_of
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import Response
from perfcontrol.response.affine import tangent_space
from perfcontrol.response.methods import is_free, is_held
from perfcontrol.response.quadratic import Factors, Quadratic, factors, hessian_matrix, largest_eigenvalue
from perfcontrol.response.respond import moved_by
from perfcontrol.response.separable import Separable

STEPS = 14  # enough where each shrinks the gap tenfold
MATRIX = 256  # free parameters up to which a Hessian is built at every step


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
    mean, covariance = _moments(problem.noise)
    if mean.ndim == 2 or covariance.ndim == 3:
        return None
    plain = is_free(problem) and is_held(problem) and not np.any(mean)
    if not plain and not (problem.feasible_set.affine and M0.size <= MATRIX):
        return None
    limits = np.asarray([contracting, enough], M0.dtype)
    steps, policies, images, gaps, form = _contract(problem, plain, M0, limits, np.asarray(min(count, STEPS)))
    M, image = policies[steps - 1], images[steps - 1]
    if not np.all(np.isfinite(image)):
        return None
    method = Separable(form, lambda: None) if plain else _Tangent(*form)
    if not method.regular:
        return None
    residual = moved_by(problem, method.form, method.step, M, method.form.gradient(M))
    return Opening(policies[:steps], images[:steps], gaps[:steps], Response(image, method.regular, residual))


_moments = program(lambda noise: (noise.mean, noise.covariance))


class _Tangent:
    """Of the last step on an affine set: the quadratic, and whether A is regular."""

    def __init__(self, form: Quadratic, A: Any):
        self.form, self.step = form, form.step
        values = np.linalg.eigvalsh(A)
        self.regular = values[0] > len(A) * np.finfo(A.dtype).eps * values[-1]


Respond = Callable[[Array], tuple[Array, Any]]


def _by_factors(problem: PerformativeProblem) -> tuple[Respond, Callable[[Any], Factors]]:
    """M -> Φ(M) and what it takes; the form of the cost made of that."""

    def respond(M: Array) -> tuple[Array, Any]:
        world = world_of(problem, M)
        form = impulse_form(world, problem.memory)
        factor = jax.scipy.linalg.cho_factor(form.G, lower=True)
        image = -jax.scipy.linalg.cho_solve(factor, form.F)
        image = image - jax.scipy.linalg.cho_solve(factor, form.F + form.G @ image)  # iterative refinement
        return image.reshape(M.shape), factors(problem, world, centred=True)

    return respond, lambda form: form


def _by_matrix(problem: PerformativeProblem, like: Array) -> tuple[Respond, Callable[[Any], Any]]:
    """The same on an affine set; the quadratic with A."""
    origin, P = tangent_space(problem.feasible_set, like)
    across = jnp.eye(like.size, dtype=like.dtype) - P

    def respond(M: Array) -> tuple[Array, Any]:
        world = world_of(problem, M)
        linear = weigh(problem, world, jnp.zeros_like(M))[1]
        H = hessian_matrix(problem, world, linear)
        A = P @ H @ P + jnp.max(jnp.diagonal(H)) * across
        factor = jax.scipy.linalg.cho_factor((A + A.T) / 2, lower=True)

        def improved(image: Array) -> Array:
            gradient = linear.reshape(-1) + H @ image.reshape(-1)
            return image - (P @ jax.scipy.linalg.cho_solve(factor, P @ gradient)).reshape(image.shape)

        return improved(improved(origin)), (linear, H, A)

    def ended(form: Any) -> tuple[Quadratic, Array]:
        linear, H, A = form
        return Quadratic(linear, 1 / largest_eigenvalue(H), H), A

    return respond, ended


@program
def _contract(problem: PerformativeProblem, plain: bool, M0: Any, limits: Any, count: Any) -> Any:
    """How many steps, their policies, images and gaps, and the form of the cost at the last."""
    respond, ended = _by_factors(problem) if plain else _by_matrix(problem, M0)

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
    form = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(respond, M0)[1])
    begun = jnp.asarray(0), rows, rows, jnp.zeros(STEPS, M0.dtype), form
    *reached, form = jax.lax.while_loop(unfinished, advance, begun)
    return *reached, ended(form)
