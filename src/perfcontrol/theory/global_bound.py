"""The global certificate: a proved modulus of contraction of Φ over the whole set, for quadratic costs and fixed
directions. No strong stability and no bounded noise is needed.

With Δ_t = Θ_t + Σ_k σ_{tk}(M') ζ_{tk} D_k and θ = σ², the cost in coordinates y of the set is [1; y]ᵀ𝔾(θ)[1; y] where
𝔾 is a polynomial in θ with positive semidefinite coefficients (every path of the expansion in ζ is a square). So on
[θ_lo, θ_hi] it increases, and |𝔾(θ') - 𝔾(θ)| ⪯ N(M - M') 𝔏 in every direction, 𝔏 the derivative of 𝔾 at θ_hi along
ℓ, where |θ_{tk}(M) - θ_{tk}(M')| ≤ ℓ_{tk} N(M - M') in the norm N(y)² = yᵀGy, G the y-block of 𝔾(θ_lo). With
ϱ = λ_max(𝔏_yy, G) and h ≥ [1; y]ᵀ𝔏[1; y] at every best response,

    N(Φ(M) - Φ(M')) ≤ √(ϱ h) N(M - M').

References: docs, theory, "The global certificate".
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Array

from perfcontrol._checks import as_array, fail
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.exact import exact_cost, exact_gradient
from perfcontrol.perturbations import AbstractPerturbation, CovarianceOperator, DirectionalPerturbation, Draws
from perfcontrol.perturbations.directional import DirectionalCovariance
from perfcontrol.policy_maps import AbstractPolicyMap, Affine
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import Constant
from perfcontrol.response import respond
from perfcontrol.theory.certificate import Assumption, Certificate, not_applicable
from perfcontrol.theory.existence import constant_mean, existence
from perfcontrol.theory.local import DENSE_LIMIT, fixed_noise, tangent_basis


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


class ScaleRange(NamedTuple):
    """σ_{tk} ∈ [low, high] over the set, (T, k); slopes: (T, k, p) in the free parameters where affine, else None;
    lipschitz: (T, k) of σ in ‖·‖_F of the free parameters."""

    low: np.ndarray
    high: np.ndarray
    slopes: np.ndarray | None
    lipschitz: np.ndarray


def scale_range(problem: PerformativeProblem, declared: Any = None) -> ScaleRange | str:
    """The range of the scales over the feasible set, or why it is not known."""
    law = problem.perturbation
    assert isinstance(law, DirectionalPerturbation)
    shape = (problem.horizon, law.directions.shape[0])
    size = int(np.prod(problem.policy_shape))

    def full(value: Any) -> np.ndarray:
        return np.broadcast_to(np.asarray(value, dtype=float), shape)

    if declared is not None:
        low, high, lipschitz = (full(as_array("scale_range", part)) for part in declared)
        if np.any(low > high) or np.any(lipschitz < 0):
            raise fail("scale_range", "low > high or a negative Lipschitz constant", "be ordered", "Check the order.")
        return ScaleRange(low, high, None, lipschitz)
    if not isinstance(law.scale, AbstractPolicyMap):
        return ScaleRange(full(law.scale), full(law.scale), np.zeros((*shape, size)), np.zeros(shape))
    if not isinstance(law.scale, Affine):
        return "the scales are a general function: declare scale_range=(low, high, Lipschitz constant)"
    flat = law.scale.slope.reshape(-1, *problem.lifted_shape)
    upper, lower = problem.lifted_set.support(flat), problem.lifted_set.support(-flat)
    if upper is None or lower is None:
        return "the scales are not known to be bounded on this feasible set: declare scale_range, or bound the set"
    offset = np.asarray(law.scale.offset, dtype=float)
    low = full(offset - np.asarray(lower, dtype=float).reshape(offset.shape))
    high = full(offset + np.asarray(upper, dtype=float).reshape(offset.shape))
    slopes = np.asarray(jax.vmap(problem.structure.adjoint)(flat), dtype=float).reshape(*offset.shape, size)
    slopes = np.broadcast_to(slopes, (*shape, size))
    return ScaleRange(low, high, slopes, np.linalg.norm(slopes, axis=-1))


def _with_variances(problem: PerformativeProblem, variances: Array) -> PerformativeProblem:
    law = problem.perturbation
    assert isinstance(law, DirectionalPerturbation)
    mean = law.mean(problem.structure.lift(problem.initial_policy()), problem.horizon)
    return eqx.tree_at(lambda p: p.perturbation, problem, _GivenVariances(law.directions, variances, mean))


@eqx.filter_jit
def _form(problem: PerformativeProblem, basis: Array, variances: Array) -> Array:
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
def _form_derivative(problem: PerformativeProblem, basis: Array, variances: Array, along: Array) -> Array:
    return jax.jvp(lambda theta: _form(problem, basis, theta), (variances,), (along,))[1]


@eqx.filter_jit
def _least_cost(problem: PerformativeProblem, variances: Array) -> Array:
    """The smallest cost on the set at given variances."""
    given, start = _with_variances(problem, variances), problem.initial_policy()
    return exact_cost(given, respond(given, start).M, start)


def _simplified(problem: PerformativeProblem) -> PerformativeProblem:
    """Without what does not enter the gradient for zero-mean noise: the initial state and the targets."""
    if float(jnp.max(jnp.abs(fixed_noise(problem).mean))) > 0:
        return problem
    cost = problem.cost
    assert isinstance(cost, QuadraticCost)
    zero = Constant(jnp.zeros(problem.state_size, problem.dtype))
    return eqx.tree_at(lambda p: (p.initial_state, p.cost), problem, (zero, QuadraticCost(cost.Q, cost.R, cost.cross)))


def largest_on_sublevel(L: np.ndarray, G: np.ndarray, level: float) -> float:
    """An upper bound of max [1;y]ᵀL[1;y] subject to [1;y]ᵀG[1;y] ≤ level, by the dual (any dual point is valid).

    Args:
        L, G: (1+q, 1+q), positive semidefinite, the y-block of G definite. level: at least the minimum of the form G.
    """
    factor = np.linalg.cholesky(G[1:, 1:])
    centre = -scipy.linalg.cho_solve((factor, True), G[1:, 0])
    slack = max(level - float(G[0, 0] + G[1:, 0] @ centre), 0.0)
    shift = np.concatenate([[1.0], centre])
    constant = float(shift @ L @ shift)
    linear = scipy.linalg.solve_triangular(factor, (L @ shift)[1:], lower=True)
    curved = scipy.linalg.solve_triangular(factor, L[1:, 1:], lower=True)
    curved = scipy.linalg.solve_triangular(factor, curved.T, lower=True)
    values, vectors = np.linalg.eigh((curved + curved.T) / 2)
    weights = (vectors.T @ linear) ** 2
    top = max(float(values[-1]), 0.0)

    def dual(log_excess: float) -> float:
        tau = top + np.exp(log_excess)
        return constant + tau * slack + float(np.sum(weights / (tau - values)))

    scale = np.log(max(top, np.sqrt(weights.sum() / max(slack, 1e-300)), 1e-300))
    found = scipy.optimize.minimize_scalar(dual, bounds=(scale - 30, scale + 10), method="bounded")
    return min(dual(float(found.x)), dual(scale), dual(scale - 30))  # type: ignore[attr-defined]


def certify_global(problem: PerformativeProblem, *, scale_range: Any = None) -> Certificate:
    """A modulus of contraction of Φ in the norm N, for quadratic costs and perturbations along fixed directions.

    Args:
        scale_range: (low, high, Lipschitz constant) of the scales over the set, each broadcast to (T, k), for scales
        that are a general function or a set on which they are not known to be bounded.

    References:
        docs: theory, "The global certificate".
    """
    exists, reason = existence(problem)
    missing = []
    if not isinstance(problem.cost, QuadraticCost):
        missing.append("the cost is not quadratic")
    if not isinstance(problem.perturbation, DirectionalPerturbation):
        missing.append("the perturbations are not of fixed directions (pc.DirectionalPerturbation)")
    elif not constant_mean(problem):
        missing.append("the mean of the perturbations depends on the policy")
    if problem.noise_reacts:
        missing.append("the noise reacts to the policy")
    if int(np.prod(problem.policy_shape)) > DENSE_LIMIT:
        missing.append(f"more than {DENSE_LIMIT} free parameters")
    ranges = None
    if not missing:
        ranges = _scale_range(problem, scale_range)
        if isinstance(ranges, str):
            missing.append(ranges)
    if missing or ranges is None or isinstance(ranges, str):
        return not_applicable("global", missing, exists, reason)
    assumptions = (
        Assumption("the modulus of contraction", "proved"),
        *([Assumption("the range of the scales", "declared")] if scale_range is not None else []),
    )
    modulus, values, note = _modulus(problem, ranges)
    if exists is None and modulus < 1:
        exists, reason = True, "Φ is a contraction of a closed set"
    return Certificate(
        "global",
        True,
        holds=modulus < 1,
        exists=exists,
        existence=reason,
        lhs=modulus,
        rhs=1.0,
        rate=modulus,
        assumptions=assumptions,
        values=values,
        notes=(note,) if note else (),
    )


_scale_range = scale_range


def _modulus(problem: PerformativeProblem, ranges: ScaleRange) -> tuple[float, dict[str, Any], str]:
    """√(ϱ h), the metric N as a matrix G with its basis, and a remark."""
    problem = _simplified(problem)
    dtype = problem.dtype
    basis = tangent_basis(problem)
    if basis.shape[1] == 0:
        return 0.0, {}, "The set is a single policy."
    low = np.where((ranges.low <= 0) & (ranges.high >= 0), 0.0, np.minimum(ranges.low**2, ranges.high**2))
    largest = np.maximum(np.abs(ranges.low), np.abs(ranges.high))
    high = largest**2
    Z = jnp.asarray(basis, dtype)
    form = np.asarray(_form(problem, Z, jnp.asarray(low, dtype)), dtype=float)
    G = form[1:, 1:]
    floor = float(np.linalg.eigvalsh(G)[0])
    if floor <= 1e-12 * float(np.linalg.norm(G, 2)):
        return np.inf, {}, "The cost is not strictly convex along the set without perturbations."
    if ranges.slopes is None:
        lipschitz = ranges.lipschitz / np.sqrt(floor)
    else:
        reduced = ranges.slopes.reshape(-1, ranges.slopes.shape[-1]) @ basis
        whitened = scipy.linalg.solve_triangular(np.linalg.cholesky(G), reduced.T, lower=True)
        lipschitz = np.linalg.norm(whitened, axis=0).reshape(largest.shape)
    along = jnp.asarray(2 * largest * lipschitz, dtype)
    L = np.asarray(_form_derivative(problem, Z, jnp.asarray(high, dtype), along), dtype=float)
    values: dict[str, Any] = {"metric": G, "basis": basis}
    if float(np.abs(L[1:, :]).max()) == 0:
        return 0.0, values, "The reaction does not move the best response."
    level = float(_least_cost(problem, jnp.asarray(high, dtype)))
    stretch = float(scipy.linalg.eigh(L[1:, 1:], G, eigvals_only=True)[-1])
    height = largest_on_sublevel((L + L.T) / 2, form, level)
    return float(np.sqrt(max(stretch, 0.0) * max(height, 0.0))), values, ""
