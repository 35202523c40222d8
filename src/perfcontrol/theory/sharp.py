"""The sharp certificate: what is true at the stable policy itself, found exactly, to first order.

RRM: the derivative of the best response, Φ' = -𝐇⁻¹𝐄 (on the tangent space where constraints are active, with the
curvature of the constraint). RRM converges locally if its spectral radius is below 1, does not if it is above, and
nothing follows at 1. RSGD: the mean field is stable iff every eigenvalue of 𝐇+𝐄 has positive real part; its largest
step, and that of the stochastic method in mean square, are in `mean_square`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import InputError, check_integer, fail
from perfcontrol.evaluate.cost_to_go import require_moments
from perfcontrol.evaluate.exact import expected_gradient
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import respond
from perfcontrol.solvers import AbstractSolver, Continuation, Result, Solution, StablePoint, solve
from perfcontrol.theory.certificate import Assumption, Certificate, not_applicable
from perfcontrol.theory.existence import existence, set_radius
from perfcontrol.theory.local import (
    DENSE_LIMIT,
    check_problem,
    hessian,
    projection_derivative,
    range_basis,
    reaction_jacobian,
    tangent_basis,
)
from perfcontrol.theory.mean_square import MeanSquareStability, mean_field_threshold, stability_at

JACOBIAN_SAMPLES = 512
SAFETY = 0.25
CONTINUED = 256  # free parameters up to which a stable policy is also looked for by continuation
AFFINE_TOLERANCE = 1e-9


class LocalModel(NamedTuple):
    """First-order model of RRM and RSGD at a stable policy M.

    response_jacobian: Φ' on the tangent space, (q, q). drift: 𝐇+𝐄 there, (q, q). basis: (p, q). damping: step ->
    derivative of the projection on the tangent space, or None where that is the identity (flat constraints).
    """

    M: Array
    response_jacobian: np.ndarray
    drift: np.ndarray
    basis: np.ndarray
    damping: Callable[[float], np.ndarray] | None


def local_model(problem: PerformativeProblem, M: Array) -> LocalModel:
    """The model at a stable policy M (free parameters)."""
    H, E = hessian(problem, M), reaction_jacobian(problem, M, M)
    gradient = expected_gradient(problem, M)
    small = 0.1 / max(float(np.linalg.norm(H, 2)), np.finfo(float).tiny)
    slope = projection_derivative(problem, M - small * gradient)
    basis = range_basis(slope)
    H, E = basis.T @ H @ basis, basis.T @ E @ basis
    slope, eye = basis.T @ slope @ basis, np.eye(basis.shape[1])
    # Φ(M') = Proj(Φ - η g(Φ; M')), differentiated in the tangent space; without curvature this is -H⁻¹E.
    system = eye - slope + small * slope @ H
    response = np.linalg.lstsq(system, -small * slope @ E, rcond=1e-13)[0] if basis.size else np.zeros((0, 0))
    damping: Callable[[float], np.ndarray] | None = None
    if basis.size and np.abs(slope - eye).max() > 1e-6:

        def curved(step: float) -> np.ndarray:
            return basis.T @ projection_derivative(problem, M - step * gradient) @ basis

        damping = curved

    return LocalModel(M, response, H + E, basis, damping)


def spectral_radius(matrix: np.ndarray) -> float:
    """Largest modulus of an eigenvalue; 0 for an empty matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def largest_mean_step(model: LocalModel) -> float:
    """Largest constant step at which repeated gradient descent is stable; 0 if it is for none."""
    if model.damping is None:
        return mean_field_threshold(model.drift)
    eye = np.eye(len(model.drift))

    def radius(step: float) -> float:
        assert model.damping is not None
        return spectral_radius(model.damping(step) @ (eye - step * model.drift))

    scale = 1 / max(float(np.linalg.norm(model.drift, 2)), np.finfo(float).tiny)
    if radius(1e-4 * scale) >= 1:
        return 0.0
    low, high = 1e-4 * scale, 2 * scale
    while radius(high) < 1 and high < 1e6 * scale:
        low, high = high, 2 * high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if radius(middle) < 1 else (low, middle)
    return low


def find_stable_policy(problem: PerformativeProblem, starts: int = 3) -> Solution:
    """The exact solver from the policy nearest to zero, then from random ones; on a bounded set then continuation."""
    draws = jax.random.normal(jax.random.key(1), (starts - 1, *problem.policy_shape), problem.dtype)
    centre, project = problem.initial_policy(), problem.feasible_set.project
    attempts: list[tuple[AbstractSolver, Array]] = [(StablePoint(), centre)]
    attempts += [(StablePoint(), project(centre + draw)) for draw in draws]
    if set_radius(problem) is not None and centre.size <= CONTINUED:
        attempts.append((Continuation(), centre))
    solution = None
    for solver, start in attempts:
        other = solve(problem, solver, start, throw=False)
        if other.result == Result.success:
            return other
        solution = solution or other
    assert solution is not None
    return solution


def proves_absence(problem: PerformativeProblem) -> bool:
    """Whether g(M; M) is affine in M (checked at points) and has no zero on an affine feasible set."""
    if not problem.feasible_set.affine:
        return False
    base = problem.initial_policy()
    basis = tangent_basis(problem)

    def field(v: np.ndarray) -> np.ndarray:
        M = base + jnp.asarray(basis @ v, base.dtype).reshape(base.shape)
        return basis.T @ np.asarray(expected_gradient(problem, M), dtype=float).reshape(-1)

    q = basis.shape[1]
    origin = field(np.zeros(q))
    matrix = basis.T @ (hessian(problem, base) + reaction_jacobian(problem, base, base)) @ basis
    points = np.random.default_rng(0).standard_normal((4, q)) * np.array([[0.3], [1.0], [3.0], [10.0]])
    for point in points:
        value = field(point)
        scale = np.abs(value).max() + np.abs(origin).max() + np.abs(matrix).max() * np.abs(point).max()
        if np.abs(value - origin - matrix @ point).max() > AFFINE_TOLERANCE * scale:
            return False
    solved = np.linalg.lstsq(matrix, -origin, rcond=1e-10)[0]
    return bool(np.linalg.norm(matrix @ solved + origin) > 1e-6 * np.linalg.norm(origin))


@eqx.filter_jit
def _responses(problem: PerformativeProblem, policies: Array) -> Array:
    return jax.lax.map(lambda M: respond(problem, M).M, policies)


def contraction_estimate(
    problem: PerformativeProblem, *, pairs: int = 16, key: Any = None, center: Array | None = None
) -> float:
    """Largest ‖Φ(M) - Φ(M')‖ / ‖M - M'‖ over sampled pairs of feasible policies: a lower estimate of the modulus.

    Args:
        pairs: how many. key: JAX random key; a fixed one if None. center: the policy that they are drawn around.
    """
    pairs = check_integer("pairs", pairs, 1)
    key = jax.random.key(11) if key is None else key
    center = problem.initial_policy() if center is None else center
    radius = problem.feasible_set.radius(problem.policy_shape)
    scale = float(1 + jnp.linalg.norm(center)) if radius is None else float(radius)
    draws = jax.random.normal(key, (2 * pairs, *problem.policy_shape), problem.dtype)
    unit = draws / jnp.linalg.norm(draws.reshape(2 * pairs, -1), axis=1)[:, None, None, None]
    reach = scale * jnp.logspace(-2, 0.5, pairs)[:, None, None, None]
    first = center + reach * unit[:pairs]
    # every other pair is close together, so that steep places count as much as distant ones
    apart = jnp.where(jnp.arange(pairs)[:, None, None, None] % 2 == 0, reach, 0.02 * scale)
    policies = jax.vmap(problem.feasible_set.project)(jnp.concatenate([first, first + apart * unit[pairs:]]))
    images = _responses(problem, policies)
    moved = jnp.linalg.norm((images[:pairs] - images[pairs:]).reshape(pairs, -1), axis=1)
    distance = jnp.linalg.norm((policies[:pairs] - policies[pairs:]).reshape(pairs, -1), axis=1)
    return float(jnp.max(jnp.where(distance > 1e-12, moved / jnp.where(distance > 0, distance, 1), 0)))


def obstacles(problem: PerformativeProblem) -> list[str]:
    """Why the exact local analysis cannot be made; empty if it can."""
    missing = []
    try:
        require_moments(problem)
    except InputError as error:
        missing.append(str(error))
    if int(np.prod(problem.policy_shape)) > DENSE_LIMIT:
        missing.append(f"more than {DENSE_LIMIT} free parameters")
    return missing


def certify_sharp(
    problem: PerformativeProblem,
    *,
    M: Array | None = None,
    batch: int = 1,
    samples: int = JACOBIAN_SAMPLES,
    pairs: int = 8,
    key: Any = None,
) -> Certificate:
    """The local test at M^PS, with the steps that it allows.

    Args:
        M: the stable policy if it is known already. batch: paths a step of RSGD. samples: of the gradient's Jacobian,
        for the mean-square step; 0 leaves that out. pairs: of policies for the global estimate; 0 leaves it out.
        key: JAX random key of these samples; a fixed one if None.
    """
    missing = obstacles(problem)
    proved, reason = existence(problem)
    if missing:
        return not_applicable("sharp", missing, proved, reason)
    found = True
    if M is None:
        solution = find_stable_policy(problem)
        found = bool(solution.result == Result.success)
        M, residual = solution.M, float(solution.stats["residual"])
        if not found and proved is None and proves_absence(problem):
            return _absent(problem)
        if not found:
            return not_applicable(
                "sharp", [f"the exact solver found no stable policy (best residual {residual:.2g})"], proved, reason
            )
    if proved is None:
        proved, reason = True, "the exact solver found one, to a relative residual of 1e-11"
    model = local_model(problem, M)
    rate = spectral_radius(model.response_jacobian)
    mean_step = largest_mean_step(model)
    values: dict[str, Any] = {"M": np.asarray(M), "mean_field_stable": mean_step > 0, "mean_step": mean_step}
    values["mean_field_eigenvalues"] = np.linalg.eigvals(model.drift)
    notes = [
        f"The mean field of RSGD is stable for constant steps below {mean_step:.4g}."
        if mean_step > 0
        else "The mean field of RSGD is unstable at every step."
    ]
    assumptions = [
        Assumption("derivatives at the stable policy, in floating point", "estimated"),
        Assumption("active constraints are strictly active", "estimated"),
    ]
    if samples and mean_step > 0:
        stability = _stability(problem, model, mean_step, batch, samples, key)
        values["mean_square"] = stability
        values["mean_square_step"] = stability.threshold_estimate
        values["mean_square_step_error"] = stability.standard_error
        notes.append(
            f"In mean square, with {batch} path{'s' * (batch > 1)} a step, RSGD is stable for constant steps below "
            f"{stability.threshold_estimate:.3g} (standard error {stability.standard_error:.1g}; steps are on the "
            f"gradient summed over stages)."
        )
        floor_step = stability.threshold_estimate / 4
        if np.isfinite(floor_step) and floor_step > 0:
            values["error_floor"] = stability.error_floor(floor_step)
            notes.append(
                f"At a quarter of that it settles at a mean-square error of {values['error_floor']:.3g} about it."
            )
        assumptions.append(Assumption("the mean-square step, from sampled Jacobians", "estimated"))
    if pairs:
        values["contraction_estimate"] = contraction_estimate(problem, pairs=pairs, key=key, center=M)
        notes.append(
            f"Over sampled pairs of feasible policies, far ones included, the best response stretched distances by at "
            f"most {values['contraction_estimate']:.3g} (an estimate; the test itself is only local)."
        )
    return Certificate(
        "sharp",
        True,
        holds=rate < 1,
        exists=proved,
        existence=reason,
        lhs=rate,
        rhs=1.0,
        rate=rate,
        assumptions=tuple(assumptions),
        values=values,
        notes=tuple(notes),
    )


def _absent(problem: PerformativeProblem) -> Certificate:
    """The verdict where the affine equation for a stable policy has no solution."""
    rate = spectral_radius(local_model(problem, problem.initial_policy()).response_jacobian)
    return Certificate(
        "sharp",
        True,
        holds=False,
        exists=False,
        existence="the equation for it is affine and has no solution",
        lhs=rate,
        rhs=1.0,
        rate=rate,
        assumptions=(Assumption("the gradient field M -> g(M; M) is affine, checked at points", "estimated"),),
        notes=("There is no stable policy to converge to.",),
    )


def _stability(
    problem: PerformativeProblem, model: LocalModel, mean_step: float, batch: int, samples: int, key: Any
) -> MeanSquareStability:
    return stability_at(
        problem,
        model.M,
        model.drift,
        model.basis,
        batch=batch,
        samples=samples,
        key=key,
        damping=model.damping,
        mean_threshold=mean_step,
    )


def mean_square_stability(
    problem: PerformativeProblem,
    M: Any = None,
    *,
    batch: int = 1,
    samples: int = JACOBIAN_SAMPLES,
    key: Any = None,
) -> MeanSquareStability:
    """How large a constant step of RSGD may be near the stable policy, in mean square.

    Args:
        M: the stable policy; None finds it. batch: paths a step. samples: of the Jacobian of the gradient.
        key: JAX random key of the samples; a fixed one if None.

    Raises:
        InputError: no exact moments, too many parameters, or no stable policy found.

    References:
        docs: theory, "Mean-square stability".
    """
    missing = obstacles(check_problem(problem))
    if missing:
        raise fail("problem", "; ".join(missing), "allow the exact local analysis", "Choose a step by trial runs.")
    if M is None:
        solution = find_stable_policy(problem)
        if solution.result != Result.success:
            raise fail("problem", "none found", "have a stable policy", "See pc.certify(problem, 'sharp').")
        M = solution.M
    model = local_model(problem, problem.check_policy("M", M))
    return _stability(problem, model, largest_mean_step(model), batch, samples, key)


def safe_step(problem: PerformativeProblem, batch: int = 1, *, safety: float = SAFETY, key: Any = None) -> float:
    """A constant step size for `pc.RSGD` that is stable in mean square near the stable policy, with a margin.

    step = safety × (threshold - 2 standard errors). The default leaves a factor four: the threshold is local, and
    where the reaction is strong, runs that start far away may grow from a third of it on.

    Args:
        batch: paths a step of RSGD. safety: fraction of the threshold. key: JAX random key; a fixed one if None.

    Returns:
        The step, on the gradient of the cost summed over stages, as `pc.RSGD` takes it.

    Raises:
        InputError: as `mean_square_stability`; or no constant step is stable.
    """
    if not 0 < safety <= 1:
        raise fail("safety", repr(safety), "lie in (0, 1]", "Pass the fraction of the threshold to use.")
    stability = mean_square_stability(problem, batch=batch, key=key)
    threshold = stability.threshold_estimate - 2 * stability.standard_error
    if not threshold > 0:
        raise fail(
            "problem",
            f"a mean field with mean-step threshold {stability.mean_threshold:.3g}",
            "have a stable mean field for some constant step",
            "Retrain by pc.StablePoint, which does not need one, or weaken the reaction.",
        )
    return safety * threshold
