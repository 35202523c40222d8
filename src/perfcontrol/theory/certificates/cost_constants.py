"""μ_t, ς_t and G_t of the stage cost: read from a quadratic one, declared or sampled for a general one."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import fail
from perfcontrol.costs import QuadraticCost
from perfcontrol.costs.base import stage_factors
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption, Status
from perfcontrol.theory.certificates.declarations import COST_CONSTANTS, Declarations
from perfcontrol.theory.facts import facts


class CostConstants(NamedTuple):
    """μ_t, ς_t, G_t and the gradient offset, (T+1,) each; NaN where not known."""

    strong_convexity: np.ndarray
    smoothness: np.ndarray
    gradient_bound: np.ndarray
    gradient_offset: np.ndarray


def cost_constants(
    problem: PerformativeProblem, declared: Declarations
) -> tuple[CostConstants, list[str], list[Assumption]]:
    """The constants, what is missing of them, and what they rest on."""
    length = problem.horizon + 1
    cost = problem.cost
    offset: Any = 0.0
    if isinstance(cost, QuadraticCost):
        *own, offset = quadratic_constants(problem)
        status: list[Status] = ["proved"] * 3
    else:
        own = [getattr(cost, name, None) for name in COST_CONSTANTS]
        status = ["declared"] * 3
        if declared.estimate and any(value is None for value in own) and hasattr(cost, "function"):
            status = ["estimated" if value is None else "declared" for value in own]
            own = [
                new if value is None else value for value, new in zip(own, estimated_constants(problem), strict=True)
            ]
        if (discount := getattr(cost, "discount", None)) is not None:
            factors = stage_factors(discount, length)
            own = [None if value is None else factors * value for value in own]
    missing: list[str] = []
    assumptions: list[Assumption] = []
    out = []
    for name, value, known in zip(COST_CONSTANTS, own, status, strict=True):
        if (given := declared.declared(name)) is not None:
            value, known = given, "declared"
        if value is None:
            example = declared.examples[name]
            missing.append(f"the cost's {name} is not known: pass {example} here or to pc.ConvexCost, or estimate=True")
            out.append(np.full(length, np.nan))
            continue
        array = np.asarray(value, dtype=float)
        if array.shape not in ((), (length,)):
            raise fail(
                name,
                f"shape {array.shape}",
                f"be a number or have shape (T+1,) = ({length},)",
                "Pass one a stage, or one for all.",
            )
        if known != "proved":
            assumptions.append(Assumption(f"the cost's {name} {array.max():.4g}", known))
        out.append(np.broadcast_to(array, (length,)))
    offset = np.broadcast_to(np.asarray(offset, dtype=float), (length,))
    strong_convexity, smoothness, gradient_bound = out
    return CostConstants(strong_convexity, smoothness, gradient_bound, offset), missing, assumptions


def spectral_norms(matrices: Any) -> np.ndarray:
    """‖·‖ of every matrix in the last two axes."""
    return np.asarray(np.linalg.norm(np.asarray(matrices, dtype=float), ord=2, axis=(-2, -1)))


def quadratic_constants(problem: PerformativeProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """μ_t, ς_t, G_t and the gradient offset of a quadratic cost, each (T+1,)."""
    assert isinstance(problem.cost, QuadraticCost)
    n = problem.state_size
    known = facts(problem)
    matrix, linear = known.stage_matrix.astype(float), known.stage_linear.astype(float)
    values = np.linalg.eigvalsh(matrix)
    cross = spectral_norms(matrix[:, :n, n:])
    own = np.maximum(spectral_norms(matrix[:, :n, :n]), spectral_norms(matrix[:, n:, n:]))
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
