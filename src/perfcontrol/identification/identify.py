"""From logs to a fitted problem: the public `fit`."""

from typing import Any

import jax
import numpy as np

from perfcontrol._checks import check_integer, check_key, fail
from perfcontrol.identification.directions import estimated_directions
from perfcontrol.identification.estimate import estimated, moments
from perfcontrol.identification.features import CONSTANT, Features, features_of
from perfcontrol.identification.location import jacobian
from perfcontrol.identification.logs import Logs
from perfcontrol.identification.moments import covariance_sums, images_of, mean_sums
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
    asked = _asked(reaction, data)
    given = None if directions is None else check_directions(directions, data)
    found = given if given is not None else _estimated_directions(data, rank, key)
    mean, scale = _chosen(asked, data, found)
    values = mean.values(data.policies), scale.values(data.policies)
    start = moments(data, found, *values, _reacting(data, found))
    return Fit(
        logs,
        data,
        np.asarray(gain, dtype=float),
        mean,
        scale,
        estimated(data, start, found, values[1], free=given is None),
    )


def check_directions(directions: Any, data: Transitions) -> np.ndarray:
    """Directions that the user gave."""
    n, m = data.x.shape[1], data.v.shape[1]
    array = np.asarray(directions, dtype=float)
    if array.ndim != 3 or array.shape[1] != n or array.shape[2] not in (n, n + m):
        required = f"have shape (k, n, n) = (k, {n}, {n}), or (k, {n}, {n + m}) to act on [x; u]"
        raise fail("directions", f"{array.shape}", required, "Pass a single direction D as [D].")
    if not np.all(np.isfinite(array)) or np.any(np.all(array == 0, axis=(1, 2))):
        raise fail("directions", "a zero or non-finite matrix", "be finite and nonzero", "Leave it out.")
    return array


def _estimated_directions(data: Transitions, rank: int | None, key: Any) -> np.ndarray:
    if rank is not None:
        check_integer("rank", rank, 0)
    n, m = data.x.shape[1], data.v.shape[1]
    free = jacobian(_free(data), np.arange(n + m + 1) < n)
    seed = np.asarray(jax.random.key_data(jax.random.key(0) if key is None else check_key(key))).ravel()
    return estimated_directions(data, free, rank, seed)


def _reacting(data: Transitions, directions: np.ndarray) -> np.ndarray:
    """Which of the mean coefficients on [x, v, 1] may react: those that Δ acts on."""
    return np.arange(data.x.shape[1] + data.v.shape[1] + 1) < directions.shape[2]


def _free(data: Transitions) -> np.ndarray:
    """Features that let every deployment be its own; with many deployments, all candidates together."""
    count = len(data.policies)
    if count <= SATURATED:
        return np.concatenate([np.ones((count, 1)), np.eye(count)[:, 1:]], axis=1)
    others = [features.values(data.policies)[:, 1:] for features in candidates(data.policies)]
    return np.concatenate([np.ones((count, 1)), *others], axis=1)


def _asked(reaction: Any, data: Transitions) -> dict[str, Features]:
    """The features that were asked for; "auto" is left out."""
    asked = reaction if isinstance(reaction, dict) else {"mean": reaction, "scale": reaction}
    unknown = set(asked) - {"mean", "scale"}
    if unknown:
        raise fail("reaction", f"the keys {sorted(asked)}", "have the keys 'mean' and 'scale'", "Leave out the others.")
    return {
        name: features_of("reaction", what, data.policies)
        for name, what in asked.items()
        if not (isinstance(what, str) and what == "auto")
    }


def _chosen(asked: dict[str, Features], data: Transitions, directions: np.ndarray) -> tuple[Features, Features]:
    """The features of mean and scale: as asked for, else as they predict best."""
    missing = {"mean", "scale"} - set(asked)
    if not len(directions):
        missing -= {"scale"}
    chosen = {"scale": CONSTANT, "mean": CONSTANT}
    if missing and len(data.policies) > 1:
        chosen |= _selected(data, directions, missing)
    chosen |= asked
    return chosen["mean"], chosen["scale"]


def _selected(data: Transitions, directions: np.ndarray, wanted: set[str]) -> dict[str, Features]:
    n, reacting = data.y.shape[1], _reacting(data, directions)
    free, count = _free(data), len(data.policies)
    first = moments(data, directions, free, np.eye(count) if count <= SATURATED else free, reacting)
    whiten = first.whiten()
    chosen = {}
    if "mean" in wanted:
        chosen["mean"] = best_mean(mean_sums(data, data.y, whiten), data.group, data.policies, n, reacting)
    if "scale" in wanted:
        sums = covariance_sums(data, first.residual(data), whiten, images_of(data, directions))
        chosen["scale"] = best_scale(sums, data.group, data.policies, n)
    return chosen
