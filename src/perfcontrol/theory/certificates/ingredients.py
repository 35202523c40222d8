"""What the constants of the theory are made of: numbers read from a problem, each with how it is known."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import as_array, fail
from perfcontrol._linalg import along_time
from perfcontrol.costs import QuadraticCost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption, Status
from perfcontrol.theory.derivatives import fixed_noise
from perfcontrol.theory.stability.strong_stability import check_per_step

DECLARABLE = (
    "strong_convexity",
    "smoothness",
    "gradient_bound",
    "sensitivity",
    "perturbation_bound",
    "noise_bound",
    "initial_bound",
    "policy_bound",
)


@dataclass(frozen=True)
class Ingredients:
    """Sizes and norms of one problem. Entries that are not known are NaN and named in `missing`.

    initial_bound: x_0 ≥ ‖x_0‖. noise_bound: W. policy_bound: sup ‖M‖_F of lifted policies. input_norm: max ‖B_t‖.
    gain_norm: max ‖K_t‖. perturbation_bound, sensitivity: ξ_t and ε_t (T,), ε_t per unit of the free parameters.
    strong_convexity, smoothness, gradient_bound: μ_t, ς_t, G_t, (T+1,); ς joint in (x, u);
    ‖∇_x c‖, ‖∇_u c‖ ≤ G_t max(‖x‖, ‖u‖) + gradient_offset_t. noise_floor: λ_min of Cov(w_t), the smallest over t;
    quiet_direction: its eigenvector. structure_norm: ‖𝓛‖ of the lift.
    """

    horizon: int
    memory: int
    state_size: int
    initial_bound: float
    noise_bound: float
    policy_bound: float
    input_norm: float
    gain_norm: float
    perturbation_bound: np.ndarray
    sensitivity: np.ndarray
    strong_convexity: np.ndarray
    smoothness: np.ndarray
    gradient_bound: np.ndarray
    gradient_offset: np.ndarray
    noise_floor: float
    quiet_direction: np.ndarray
    noise_mean: float
    structure_norm: float
    missing: tuple[str, ...]
    assumptions: tuple[Assumption, ...]


def _spectral(matrices: Any) -> np.ndarray:
    return np.asarray(np.linalg.norm(np.asarray(matrices, dtype=float), ord=2, axis=(-2, -1)))


def quadratic_constants(problem: PerformativeProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """μ_t, ς_t, G_t and the gradient offset of a quadratic cost, each (T+1,)."""
    assert isinstance(problem.cost, QuadraticCost)
    n = problem.state_size
    form = problem.cost.form(problem.horizon)
    matrix, linear = np.asarray(form.matrix, dtype=float), np.asarray(form.linear, dtype=float)
    values = np.linalg.eigvalsh(matrix)
    cross = _spectral(matrix[:, :n, n:])
    own = np.maximum(_spectral(matrix[:, :n, :n]), _spectral(matrix[:, n:, n:]))
    offset = np.maximum(np.linalg.norm(linear[:, :n], axis=1), np.linalg.norm(linear[:, n:], axis=1))
    return 2 * np.maximum(values[:, 0], 0), 2 * values[:, -1], 2 * (own + cross), 2 * offset


def estimated_constants(
    problem: PerformativeProblem, reach: float = 10.0, samples: int = 64, seed: int = 0
) -> tuple[float, float, float]:
    """μ, ς and G of a smooth general cost from its Hessians and gradients at sampled points of norm up to `reach`."""
    function = problem.cost.function  # type: ignore[attr-defined]
    n, m, T = problem.state_size, problem.input_size, problem.horizon
    generator = np.random.default_rng(seed)
    z = generator.standard_normal((samples, n + m))
    z *= (reach * generator.uniform(size=(samples, 1))) / np.linalg.norm(z, axis=1, keepdims=True)
    times = jnp.asarray(generator.integers(0, T + 1, samples))

    def cost(t: Any, point: Any) -> Any:
        return function(t, point[:n], point[n:])

    points = jnp.asarray(z, problem.dtype)
    hessians = np.asarray(jax.vmap(jax.hessian(cost, argnums=1))(times, points), dtype=float)
    gradients = np.asarray(jax.vmap(jax.grad(cost, argnums=1))(times, points), dtype=float)
    values = np.linalg.eigvalsh((hessians + hessians.transpose(0, 2, 1)) / 2)
    size = np.maximum(np.linalg.norm(z[:, :n], axis=1), np.linalg.norm(z[:, n:], axis=1))
    slope = np.maximum(np.linalg.norm(gradients[:, :n], axis=1), np.linalg.norm(gradients[:, n:], axis=1))
    return max(float(values.min()), 0.0), float(values.max()), float(np.max(slope / size))


def gather(
    problem: PerformativeProblem, declared: dict[str, Any] | None = None, *, estimate: bool = False
) -> Ingredients:
    """Read the ingredients of a problem; what the user declares goes before what the problem knows.

    Args:
        declared: values by name, `DECLARABLE`. estimate: sample the constants of a general cost that lacks them.

    Raises:
        InputError: an unknown name, a negative value, a wrong length.
    """
    declared = dict(declared or {})
    for name in declared:
        if name not in DECLARABLE:
            raise fail("declared", repr(name), f"name one of {DECLARABLE}", "Check the spelling.")
    T = problem.horizon
    noise = fixed_noise(problem)
    missing: list[str] = ["the noise reacts to the policy"] if problem.noise_reacts else []
    assumptions: list[Assumption] = []

    def number(name: str, own: Any, what: str, source: str) -> float:
        if name in declared:
            value = float(as_array(name, declared[name]))
            if value < 0:
                raise fail(name, f"{value:.4g}", "be non-negative", "It bounds a norm.")
            assumptions.append(Assumption(f"{what} {value:.4g}", "declared"))
            return value
        if own is None:
            missing.append(f"{what} is not known: {source}")
            return np.nan
        return float(own)

    def series(name: str, own: Any, what: str, source: str) -> np.ndarray:
        if name in declared:
            assumptions.append(Assumption(what, "declared"))
            return check_per_step(name, declared[name], T)
        if own is None:
            missing.append(f"{what} is not known: {source}")
            return np.full(T, np.nan)
        if name == "sensitivity" and declared_by_family(problem):
            assumptions.append(Assumption(what, "declared"))
        return check_per_step(name, own, T)

    radius = problem.feasible_set.radius(problem.policy_shape)
    lifted = None if radius is None else problem.structure.norm * float(radius)
    covariances = np.asarray(noise.covariance, dtype=float)
    covariances = covariances if covariances.ndim == 3 else covariances[None]
    values, vectors = np.linalg.eigh(covariances)
    quietest = int(np.argmin(values[:, 0]))
    floor = float(values[quietest, 0])
    floor = 0.0 if floor <= 1e-12 * max(float(values.max()), np.finfo(float).tiny) else floor
    constants = _cost_constants(problem, declared, estimate, missing, assumptions)
    return Ingredients(
        horizon=T,
        memory=problem.memory,
        state_size=problem.state_size,
        initial_bound=number(
            "initial_bound", problem.initial_state.bound, "the bound of the initial state", "its law is unbounded"
        ),
        noise_bound=number("noise_bound", noise.bound, "the bound W of the noise", "its law is unbounded"),
        policy_bound=number(
            "policy_bound", lifted, "the largest norm of a feasible policy", "the feasible set is unbounded"
        ),
        input_norm=float(np.max(_spectral(problem.system.B))),
        gain_norm=float(np.max(_spectral(problem.gain))),
        perturbation_bound=series(
            "perturbation_bound",
            problem.perturbation_bound(),
            "the almost-sure bound of the perturbations",
            "the family does not know it on this feasible set",
        ),
        sensitivity=series(
            "sensitivity",
            problem.sensitivity(),
            "the sensitivity of the perturbation law",
            "declare it, or estimate it",
        ),
        strong_convexity=constants[0],
        smoothness=constants[1],
        gradient_bound=constants[2],
        gradient_offset=constants[3],
        noise_floor=floor,
        quiet_direction=vectors[quietest, :, 0],
        noise_mean=float(np.max(np.linalg.norm(np.asarray(along_time(noise.mean, 1, T)), axis=-1))),
        structure_norm=problem.structure.norm,
        missing=tuple(missing),
        assumptions=tuple(assumptions),
    )


def declared_by_family(problem: PerformativeProblem) -> bool:
    """Whether the perturbation's sensitivity is the user's word (a sampled family) and not computed."""
    return type(problem.perturbation).__name__ == "SampledPerturbation"


def _cost_constants(
    problem: PerformativeProblem,
    declared: dict[str, Any],
    estimate: bool,
    missing: list[str],
    assumptions: list[Assumption],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """μ_t, ς_t, G_t, offset, (T+1,) each."""
    length = problem.horizon + 1
    names = ("strong_convexity", "smoothness", "gradient_bound")
    if isinstance(problem.cost, QuadraticCost):
        own: list[Any] = list(quadratic_constants(problem))
        status: list[Status] = ["proved"] * 3
    else:
        own = [getattr(problem.cost, name, None) for name in names] + [0.0]
        status = ["declared"] * 3
        if estimate and any(value is None for value in own[:3]) and hasattr(problem.cost, "function"):
            sampled = estimated_constants(problem)
            status = ["estimated" if value is None else "declared" for value in own[:3]]
            own = [new if value is None else value for value, new in zip(own[:3], sampled, strict=True)] + [0.0]
    out = []
    for index, name in enumerate(names):
        value, known = own[index], status[index]
        if name in declared:
            value, known = declared[name], "declared"
        if value is None:
            missing.append(f"the cost's {name} is not known: give it to the cost, or pass estimate=True")
            out.append(np.full(length, np.nan))
            continue
        array = np.broadcast_to(np.asarray(value, dtype=float), (length,))
        if np.any(array < 0):
            raise fail(name, f"{array.min():.4g}", "be non-negative", "Check the sign.")
        if known != "proved":
            assumptions.append(Assumption(f"the cost's {name} {array.max():.4g}", known))
        out.append(array)
    return out[0], out[1], out[2], np.broadcast_to(np.asarray(own[3], dtype=float), (length,))
