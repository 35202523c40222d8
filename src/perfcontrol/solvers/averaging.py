"""The average of RSGD's iterates, and an estimate of its covariance from the same run.

Near M^PS the error obeys e_{n+1} = (I - η_n J) e_n - η_n ξ_n, with J the derivative of g(M; M) = ∇_1 C(M; M) and V the
covariance of the gradient noise ξ. `Sandwich` takes J from exact derivatives and V from the run's own gradients, and
follows the second moments of this recursion, so that its answer is that of the run's finite length; per N it tends to
J⁻¹ V J⁻ᵀ. `BatchMeans` knows neither: it looks at how the averages of consecutive stretches of the run scatter.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol._programs import Numbers, program
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.exact import exact_gradient
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response.projected import projection_slope
from perfcontrol.solvers.step_sizes import size_of

COVARIANCES = ("sandwich", "batch means")


class Tally(eqx.Module):
    """What a run carries: sums over the iterates since the burn-in."""

    start: Numbers
    iterate: Numbers
    mean: Numbers  # of the iterates; the iterate itself before there is any
    count: Numbers
    spread: Numbers  # Σ g gᵀ, (p, p); or sums of the iterates by batch, (batches, p)
    clipped: Numbers  # steps that a set which is not affine cut short


class Average(eqx.Module):
    """How `pc.RSGD(average=...)` averages: which iterates, and how the covariance of their average is estimated.

    "sandwich" needs a quadratic cost and known moments: J̄ exactly, V from the run; O(p²) memory, and a pass of small
    matrix products over the run at its end. "batch means" needs nothing but a long run: every batch must outlast the
    memory of the iteration, 1 / (η_n λ) steps for the smallest eigenvalue λ of J̄. Where batches resemble their
    neighbours the covariance is raised by (1 + r) / (1 - r), as for a first-order autoregression with correlation r;
    `confidence_region` refuses r > 0.6.

    `.stats` of the run: `covariance`, `averaged` (iterates), `clipped` (averaged steps that a set which is
    not affine cut short), `start_offset` (policy_shape: what is left of the start in the average, to first order; with
    the sandwich, else zero), `batches` (complete ones; 0 for the sandwich), `batch_correlation` (r).

    Args:
        burn_in: fraction of the steps left out at the start, in [0, 1).
        covariance: "sandwich" or "batch means"; None: the first where it applies, else the second.

    Raises:
        InputError: a fraction outside [0, 1), an unknown name.

    References:
        Cutler, Díaz and Drusvyatskiy (2022) for the limit; docs: theory, "Averaged iterates".
    """

    burn_in: float = eqx.field(static=True)
    covariance: str | None = eqx.field(static=True)

    def __init__(self, burn_in: float = 0.25, covariance: str | None = None):
        if not (isinstance(burn_in, int | float) and 0 <= burn_in < 1):
            raise fail(
                "burn_in",
                str(burn_in),
                "be a fraction in [0, 1)",
                "Pass for example 0.25, which leaves out the first quarter.",
            )
        if covariance is not None and covariance not in COVARIANCES:
            raise fail(
                "covariance",
                repr(covariance),
                f"be one of {COVARIANCES} or None",
                "Pass None to let the problem choose.",
            )
        self.burn_in, self.covariance = float(burn_in), covariance

    def exact(self, problem: PerformativeProblem) -> bool:
        """Whether the covariance is the sandwich."""
        return self.covariance != "batch means" and _known_moments(problem)

    def check(self, problem: PerformativeProblem, steps: int) -> None:
        """Raise where the covariance asked for cannot be had from so many steps."""
        if self.covariance == "sandwich" and not _known_moments(problem):
            raise fail(
                "covariance",
                "'sandwich' on a problem without exact derivatives",
                "be 'batch means' where the cost is not quadratic or moments are unknown",
                "Pass None, which chooses.",
            )
        shortest = 1 if self.exact(problem) else 2 * batches(problem)
        if steps - self.first(steps) < shortest:
            raise fail(
                "steps",
                f"{steps}, of which {steps - self.first(steps)} are averaged",
                f"leave at least {shortest} to average over",
                "Take more steps, or a smaller burn_in.",
            )

    def first(self, steps: int) -> int:
        """The first step whose iterate is averaged."""
        return int(self.burn_in * steps)

    def init(self, problem: PerformativeProblem, M0: Array) -> Tally:
        """Nothing averaged yet."""
        zero = jnp.zeros((), int)
        rows = M0.size if self.exact(problem) else batches(problem)
        return Tally(M0, M0, M0, zero, jnp.zeros((rows, M0.size), M0.dtype), zero)

    def add(
        self, problem: PerformativeProblem, tally: Tally, n: Array, steps: int, M: Array, gradient: Array, moved: Array
    ) -> Tally:
        """The tally after step n has led to M by this gradient, the projection having moved the result by `moved`."""
        first = self.first(steps)
        counts = n >= first
        count = tally.count + counts
        mean = jnp.where(counts, tally.mean + (M - tally.mean) / jnp.maximum(count, 1), M)
        mean = jnp.where(count == 1, M, mean)
        if self.exact(problem):
            g = gradient.reshape(-1)
            spread = tally.spread + jnp.where(counts, jnp.outer(g, g), 0)
        else:
            length = (steps - first) // batches(problem)
            # Rows past the last are dropped; before the burn-in nothing is added.
            spread = tally.spread.at[(n - first) // length].add(jnp.where(counts, M.reshape(-1), 0))
        cut = counts & (moved > 1e-6 * (1 + jnp.sqrt(jnp.sum(M**2)))) & (not problem.feasible_set.affine)
        return Tally(tally.start, M, mean, count, spread, tally.clipped + cut)

    def statistics(
        self,
        problem: PerformativeProblem,
        weight: float,
        tally: Tally,
        steps: int,
        step_size: Any,
        sampled: bool,
    ) -> dict[str, Any]:
        """`covariance` (p, p) of the average, and what is needed to judge it; gradients are weight ∇_1 C."""
        first = self.first(steps)
        if self.exact(problem):
            covariance, felt = _sandwich(problem, weight, tally, step_size, first, sampled)
            complete, correlation = jnp.zeros((), int), jnp.zeros((), covariance.dtype)
        else:
            covariance, complete, correlation = _batch_means(tally, (steps - first) // batches(problem))
            felt = jnp.zeros_like(tally.mean)
        return {
            "covariance": covariance,
            "averaged": tally.count,
            "clipped": tally.clipped,
            "start_offset": felt,
            "batches": complete,
            "batch_correlation": correlation,
        }


def as_average(value: Any) -> Average | None:
    """True for the default, False for none, or an `Average`."""
    if isinstance(value, Average):
        return value
    if value is True or value is False:
        return Average() if value else None
    raise fail("average", repr(value), "be True, False or a pc.Average", "Pass pc.Average(burn_in=0.5).")


def batches(problem: PerformativeProblem) -> int:
    """How many stretches of the run are compared: enough for a region of all p parameters."""
    size = 1
    for length in problem.policy_shape:
        size *= length
    return 20 + 2 * size


def _known_moments(problem: PerformativeProblem) -> bool:
    """Whether exact derivatives are to be had, which infinite horizons need in any case; from types and shapes."""
    if not isinstance(problem.cost, QuadraticCost):
        return False
    if not problem.is_finite:
        return True
    policy = jax.ShapeDtypeStruct(problem.lifted_shape, problem.dtype)
    spread = eqx.filter_eval_shape(lambda law, M: law.covariance(M, problem.horizon), problem.perturbation, policy)
    return spread is not None


@program
def mean_field_jacobian(problem: PerformativeProblem, M: Any) -> Array:
    """J̄ = 𝐇 + 𝐄, the derivative of g(M; M), (p, p): column j by parameter j."""
    _, push = jax.linearize(lambda policy: exact_gradient(problem, policy, policy), M)
    eye = jnp.eye(M.size, dtype=M.dtype).reshape(M.size, *M.shape)
    return jax.lax.map(push, eye, batch_size=min(16, M.size)).reshape(M.size, M.size).T


@program(on_device=True)
def _sandwich(
    problem: PerformativeProblem, weight: float, tally: Tally, step_size: Any, first: int, sampled: bool
) -> tuple[Array, Array]:
    """Covariance of the mean of e_{first+1}, ..., e_{first+count}, infinite where there is none, and what it keeps of
    the start."""
    J, size, dtype = weight * mean_field_jacobian(problem, tally.mean), tally.mean.size, tally.mean.dtype
    count, apart = tally.count, (tally.start - tally.mean).reshape(-1)
    V = tally.spread / jnp.maximum(count, 1) if sampled else jnp.zeros_like(tally.spread)
    if problem.feasible_set.affine:
        tangent = projection_slope(problem.feasible_set, tally.mean)
        J, V, apart = tangent @ J @ tangent, tangent @ V @ tangent, tangent @ apart
    # Early steps may be too long for the linear picture; the projection, or chance, has kept the run together.
    longest = 2 / jnp.maximum(jnp.linalg.norm(J, 2), jnp.finfo(dtype).tiny)

    def follow(n: Array, carry: Any) -> Any:
        error, cross, total, left, felt = carry  # E eeᵀ, E seᵀ, E ssᵀ with s the sum of the errors that count; E e, E s
        eta = jnp.minimum(size_of(step_size, n).astype(dtype), longest)
        step = jnp.eye(size, dtype=dtype) - eta * J
        error = step @ error @ step.T + eta**2 * V
        cross, left = cross @ step.T, step @ left
        counts = (n >= first).astype(dtype)
        total = total + counts * (cross + cross.T + error)
        return error, cross + counts * error, total, left, felt + counts * left

    zero, none = jnp.zeros((size, size), dtype), jnp.zeros(size, dtype)
    *_, total, _, felt = jax.lax.fori_loop(0, first + count, follow, (zero, zero, zero, apart, none))
    covariance = jnp.where(count > 0, total / jnp.maximum(count, 1) ** 2, jnp.inf * jnp.eye(size, dtype=dtype))
    return covariance, (felt / jnp.maximum(count, 1)).reshape(tally.mean.shape)


@program(on_device=True)
def _batch_means(tally: Tally, length: int) -> tuple[Array, Array, Array]:
    """Covariance of the average by the scatter of the complete batches, their number, and how alike neighbours are.

    The last is the correlation of successive batches along the direction in which they scatter most, corrected for the
    bias -(1 + 3r)/B that it has from B batches.
    """
    number, size = tally.spread.shape
    complete = jnp.minimum(tally.count // length, number)
    inside = (jnp.arange(number) < complete)[:, None]
    means = tally.spread / length
    centre = jnp.sum(jnp.where(inside, means, 0), axis=0) / jnp.maximum(complete, 1)
    deviations = jnp.where(inside, means - centre, 0)
    covariance = deviations.T @ deviations / (jnp.maximum(complete - 1, 1) * jnp.maximum(complete, 1))
    main = deviations @ jnp.linalg.eigh(covariance)[1][:, -1]
    correlation = jnp.sum(main[1:] * main[:-1]) / jnp.maximum(jnp.sum(main**2), jnp.finfo(main.dtype).tiny)
    correlation = jnp.clip(correlation + (1 + 3 * correlation) / jnp.maximum(complete, 1), 0, 0.9)
    covariance = covariance * (1 + correlation) / (1 - correlation)
    covariance = jnp.where(complete > 1, covariance, jnp.inf * jnp.eye(size, dtype=means.dtype))
    return covariance, complete, correlation
