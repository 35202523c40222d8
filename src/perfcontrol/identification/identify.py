"""From logs to a fitted problem: the public `fit`."""

from typing import Any

import numpy as np

from perfcontrol._checks import fail
from perfcontrol.identification.estimate import covariances, estimate, images_of
from perfcontrol.identification.features import CONSTANT, Features, features_of
from perfcontrol.identification.logs import Logs
from perfcontrol.identification.moments import covariance_sums, inverse_factors, mean_sums
from perfcontrol.identification.result import Fit
from perfcontrol.identification.selection import best_mean, best_scale, candidates
from perfcontrol.identification.transitions import Transitions, transitions_of

SATURATED = 12  # deployments up to which selection starts from one coefficient for each of them


def fit(
    logs: Logs,
    gain: Any = 0,
    memory: int | None = None,
    directions: Any = None,
    rank: int | None = None,
    reaction: Any = "auto",
    key: Any = None,
) -> Fit:
    """Identify a plant and its reaction from logs: A, B, the noise, how mean and covariance of Δ_t follow the policy.

    Given x_t and u_t, x_{t+1} has mean (A + Θ(M')) x_t + B u_t + w̄ and covariance Σ + Σ_k σ_k(M')² D_k x_t x_tᵀ D_kᵀ,
    also in the closed loop, since u_t knows the noise up to w_{t-1} only. Weighted least squares for the mean, weighted
    regression of squared residuals for the covariance, each with the weights of the other until they rest (Fisher
    scoring for the Gaussian likelihood, consistent under any law with these moments).

    Args:
        logs: episodes under one or more policies.
        gain: K, (m, n), of u = -K x + Σ_i M[i-1] w_{t-i}, or (T+1, m, n); 0 for none.
        memory: lags of the policies of the fitted problem; None for those of the logs.
        directions: D_k, (k, n, n), or (k, n, n+m) acting on [x; u]; None estimates them.
        rank: how many directions to estimate; None chooses on held-out episodes.
        reaction: "auto" (chosen on held-out data), "constant", "norm", "squared norm", "affine", or a function
            M -> (q,) of the lifted policy in jax.numpy, for mean and scales alike; a dict sets "mean" and "scale"
            apart.
        key: JAX random key of the held-out episodes; a fixed one if None.

    Returns:
        A `Fit`: estimates with standard errors that are robust to unequal variances, `problem(...)`, `ensemble(...)`,
        `table()`; str() is a paragraph.

    Raises:
        InputError: logs, gain, memory, directions or reaction that do not fit one another.

    References:
        Xing, Gravell, He, Johansson, Summers, arXiv 2002.06613 (covariances, and what of them can be identified).
    """
    data = transitions_of(logs, gain, memory)
    fixed = _directions(directions, data)
    mean, scale = _chosen(reaction, data, fixed)
    return Fit(logs, data, np.asarray(gain, dtype=float), fixed, mean, scale, _moments(data, fixed, mean, scale))


def _directions(directions: Any, data: Transitions) -> np.ndarray:
    n, m = data.x.shape[1], data.v.shape[1]
    if directions is None:
        raise fail("directions", "None", "be given", "Pass the D_k of Δ = Σ_k σ_k(M) ζ_k D_k, shape (k, n, n).")
    array = np.asarray(directions, dtype=float)
    if array.ndim != 3 or array.shape[1] != n or array.shape[2] not in (n, n + m):
        required = f"have shape (k, n, n) = (k, {n}, {n}), or (k, {n}, {n + m}) to act on [x; u]"
        raise fail("directions", f"{array.shape}", required, "A single direction D is passed as [D].")
    if not np.all(np.isfinite(array)) or np.any(np.all(array == 0, axis=(1, 2))):
        raise fail("directions", "a zero or non-finite matrix", "be finite and nonzero", "Leave it out.")
    return array


def _reacting(data: Transitions, directions: np.ndarray) -> np.ndarray:
    """Which of the mean coefficients on [x, v, 1] may react: those that Δ acts on."""
    n, m = data.x.shape[1], data.v.shape[1]
    return np.arange(n + m + 1) < (directions.shape[2] if len(directions) else n)


def _moments(data: Transitions, directions: np.ndarray, mean: Features, scale: Features) -> Any:
    values = mean.values(data.policies), scale.values(data.policies)
    return estimate(data, directions, *values, _reacting(data, directions))


def _chosen(reaction: Any, data: Transitions, directions: np.ndarray) -> tuple[Features, Features]:
    """The features of mean and scale, as asked for or as they predict best."""
    asked = reaction if isinstance(reaction, dict) else {"mean": reaction, "scale": reaction}
    unknown = set(asked) - {"mean", "scale"}
    if unknown:
        raise fail("reaction", f"the keys {sorted(asked)}", "have the keys 'mean' and 'scale'", "Leave out the others.")
    known = {
        name: features_of("reaction", asked[name], data.policies)
        for name in asked
        if not isinstance(asked[name], str) or asked[name] != "auto"
    }
    missing = {"mean", "scale"} - set(known)
    if len(data.policies) == 1:
        known |= dict.fromkeys(missing, CONSTANT)
    elif missing:
        known = _selected(data, directions, missing) | known
    return known["mean"], known["scale"]


def _selected(data: Transitions, directions: np.ndarray, wanted: set[str]) -> dict[str, Features]:
    count, n = len(data.policies), data.y.shape[1]
    reacting, images = _reacting(data, directions), images_of(data, directions)
    rich = np.eye(count)
    if count > SATURATED:
        rich = np.concatenate([f.values(data.policies)[:, 1:] for f in candidates(data.policies)], axis=1)
    free = np.concatenate([np.ones((count, 1)), rich[:, 1:]], axis=1)
    first = estimate(data, directions, free, np.eye(count), reacting)
    V = covariances(data, first.spread.noise, first.variances, images)
    whiten = inverse_factors(V, float(np.trace(first.spread.noise)))
    chosen = {}
    if "mean" in wanted:
        chosen["mean"] = best_mean(mean_sums(data, data.y, whiten), data.group, data.policies, n, reacting)
    if "scale" in wanted:
        sums = covariance_sums(data, first.location.residual(data), whiten, images)
        chosen["scale"] = best_scale(sums, data.group, data.policies, n)
    return chosen
