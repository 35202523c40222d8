"""How strongly the law of the perturbations reacts: ε_t ≥ W₁(D_t(M), D_t(M')) / ‖M - M'‖_F, spectral ground norm."""

import importlib
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import check_integer, check_key, fail
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.theory.assumptions import Status
from perfcontrol.theory.precision import in_double

METHODS = ("analytic", "coupling", "transport")


@dataclass(frozen=True)
class SensitivityEstimate:
    """ε_t by one method.

    epsilon: (T,). standard_error: (T,) of sampling, or None where there is none. status: "proved" or "estimated".
    remark: which way the number errs.
    """

    epsilon: np.ndarray
    standard_error: np.ndarray | None
    method: str
    status: Status
    remark: str


@in_double
def estimate_sensitivity(
    problem: PerformativeProblem,
    *,
    method: str = "coupling",
    key: Any = None,
    policies: int = 8,
    samples: int = 128,
    distance: float = 0.1,
) -> SensitivityEstimate:
    """The sensitivities ε_t per unit of ‖M - M'‖_F (free parameters).

    Args:
        problem: the problem.
        method: "analytic": what the family knows. "coupling": the mean speed E ‖dΔ_t/dM [V]‖ of the draws with the
            randomness held fixed, by automatic differentiation, the largest over sampled policies and directions V;
            any coupling bounds W₁ from above, so only the search over M and V is a sample. "transport": optimal
            transport between empirical measures at pairs of policies (needs POT); biased upward in many dimensions.
        key: JAX random key; needed except for "analytic".
        policies: how many feasible policies (or pairs).
        samples: draws at each.
        distance: between the policies of a pair ("transport").

    Raises:
        InputError: an unknown method; an analytic value that the family does not know; POT missing.

    References:
        Assumption A3; docs: theory, "Sensitivities".
    """
    check_problem(problem)
    if method == "analytic":
        epsilon = problem.sensitivity()
        if epsilon is None:
            raise fail("method", "'analytic'", "fit a family that knows its sensitivity", "Use method='coupling'.")
        return SensitivityEstimate(
            np.asarray(epsilon, dtype=float), None, method, "proved", "an upper bound, exact for some families"
        )
    if method not in METHODS:
        raise fail("method", repr(method), "be 'analytic', 'coupling' or 'transport'", "Pass one of these names.")
    key = check_key(key)
    policies, samples = check_integer("policies", policies, 1), check_integer("samples", samples, 2)
    policy_key, draw_key = jax.random.split(key)
    points = feasible_policies(problem, policy_key, policies)
    if method == "coupling":
        return _coupling(problem, points, jax.random.split(draw_key, samples))
    return _transport(problem, points, draw_key, samples, distance)


def feasible_policies(problem: PerformativeProblem, key: Array, count: int) -> Array:
    """Sampled feasible policies, (count, *policy_shape): projections of Gaussians of several sizes."""
    radius = problem.feasible_set.radius(problem.policy_shape)
    scale = 1.0 if radius is None else float(radius)
    draws = scale * jax.random.normal(key, (count, *problem.policy_shape), problem.dtype)
    sizes = jnp.linspace(0, 1, count)[:, None, None, None]
    return jax.vmap(problem.feasible_set.project)(problem.initial_policy() + sizes * draws)


def _draws(problem: PerformativeProblem, M: Array, key: Array) -> Array:
    return problem.perturbation.sample(key, problem.structure.lift(M), problem.steps).dense()


@eqx.filter_jit
def _speeds(problem: PerformativeProblem, M: Array, keys: Array) -> Array:
    """dΔ_t/dM for every draw: (S, T, n, columns, p)."""

    def one(key: Array) -> Array:
        slope = jax.jacfwd(lambda V: _draws(problem, V, key))(M)
        return slope.reshape(*slope.shape[:3], -1)

    return jax.lax.map(one, keys)


def _coupling(problem: PerformativeProblem, points: Array, keys: Array) -> SensitivityEstimate:
    best = np.zeros(problem.steps)
    error = np.zeros(problem.steps)
    for M in points:
        slopes = np.asarray(_speeds(problem, M, keys), dtype=float)
        for t in range(problem.steps):
            at = slopes[:, t]
            flat = at.reshape(-1, at.shape[-1])
            _, vectors = np.linalg.eigh(flat.T @ flat)
            for V in vectors.T[-3:]:
                speeds = np.linalg.norm(at @ V, ord=2, axis=(-2, -1))
                if speeds.mean() > best[t]:
                    best[t], error[t] = speeds.mean(), speeds.std(ddof=1) / np.sqrt(len(speeds))
    return SensitivityEstimate(
        best,
        error,
        "coupling",
        "estimated",
        "an upper bound of W₁ at the sampled policies; other policies may react more",
    )


def _transport(
    problem: PerformativeProblem, points: Array, key: Array, samples: int, distance: float
) -> SensitivityEstimate:
    try:
        ot = importlib.import_module("ot")
    except ImportError as error:
        raise fail(
            "method",
            "'transport' without the package POT",
            "be one that is installed",
            'Install it with pip install "perfcontrol[interop]", or use method="coupling".',
        ) from error
    T = problem.steps
    draw = eqx.filter_jit(lambda M, keys: jax.lax.map(lambda k: _draws(problem, M, k), keys))
    best, error = np.zeros(T), np.zeros(T)
    for index, M in enumerate(points):
        direction_key, *draw_keys = jax.random.split(jax.random.fold_in(key, index), 3)
        step = jax.random.normal(direction_key, M.shape, M.dtype)
        other = problem.feasible_set.project(M + distance * step / jnp.linalg.norm(step))
        apart = float(jnp.linalg.norm(other - M))
        if apart < 1e-9:
            continue
        first, second = (
            np.asarray(draw(policy, jax.random.split(k, samples)), dtype=float)
            for policy, k in zip((M, other), draw_keys, strict=True)
        )
        halves = slice(0, samples // 2), slice(samples // 2, samples)
        for t in range(T):
            value = _wasserstein(ot, first[:, t], second[:, t]) / apart
            split = [_wasserstein(ot, first[h, t], second[h, t]) / apart for h in halves]
            if value > best[t]:
                best[t], error[t] = value, float(np.std(split, ddof=1)) / np.sqrt(2)
    return SensitivityEstimate(
        best, error, "transport", "estimated", "biased upward by the finite samples, the more so in many dimensions"
    )


def _wasserstein(ot: Any, first: np.ndarray, second: np.ndarray) -> float:
    """W₁ between two empirical measures of matrices, spectral ground norm."""
    cost = np.linalg.norm(first[:, None] - second[None], ord=2, axis=(-2, -1))
    weights = [np.full(len(part), 1 / len(part)) for part in (first, second)]
    return float(ot.emd2(*weights, cost))
