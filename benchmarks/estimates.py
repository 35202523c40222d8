"""Errors of what `pc.fit` estimates: how they fall with the number of episodes, how often intervals cover them."""

from typing import Any

import numpy as np

import perfcontrol as pc
from benchmarks.plants import Plant, plant

HORIZON = 10
Errors = dict[str, np.ndarray]


def errors(made: Plant, fit: pc.Fit) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Error of every parameter and half its 95 % interval, by block; signs of directions and scales are aligned."""
    n = len(made.A)
    truth: dict[str, np.ndarray] = {"A": made.A, "B": made.B, "noise_mean": np.zeros(n), "noise_covariance": made.noise}
    truth["deployed_scale"] = np.stack([made.scales(M) for M in made.policies])
    if made.features["mean"] == "affine":  # coefficients of the coordinates that the fit has chosen, which are linear
        coordinates = np.asarray(fit.mean_features.function(made.axis))
        truth["mean_reaction"] = coordinates[:, None, None] * made.slope
    truth["directions"] = made.directions
    found = {}
    for name, value in truth.items():
        found_here = getattr(fit, name)
        low, high = found_here.interval()
        estimate, reach = np.asarray(found_here.mean), (high - low) / 2
        sign = np.ones(())
        if name == "deployed_scale":
            sign = np.sign(np.sum(estimate * value, axis=0))
        if name == "directions":
            sign = np.sign(np.sum(estimate * value, axis=(1, 2)))[:, None, None]
        if np.any(reach > 0):
            triangle = np.triu_indices(n) if name == "noise_covariance" else ...
            found[name] = ((sign * estimate - value)[triangle].ravel(), reach[triangle].ravel())
    return found


def recovery(systems: int, sizes: tuple[int, ...]) -> list[str]:
    """Slopes of log error (root mean square over a block) against log episodes, over systems."""
    slopes: dict[str, list[float]] = {}
    for seed in range(systems):
        made, sizes_of = plant(seed), {}
        for size in sizes:
            logs = made.logs(np.random.default_rng([seed, size]), size, HORIZON)
            fit = pc.fit(logs, made.K, directions=made.directions, reaction=made.features)
            for name, (error, _) in errors(made, fit).items():
                sizes_of.setdefault(name, []).append(np.sqrt(np.mean(error**2)))
        for name, values in sizes_of.items():
            slopes.setdefault(name, []).append(float(np.polyfit(np.log(sizes), np.log(values), 1)[0]))
    lines = ["| block | systems | median slope | lowest | highest |", "| --- | --- | --- | --- | --- |"]
    for name, found in slopes.items():
        row = (np.median(found), min(found), max(found))
        lines.append(f"| {name} | {len(found)} | " + " | ".join(f"{x:.2f}" for x in row) + " |")
    return lines


def coverage(made: Plant, sets: int, episodes: int, given: bool) -> list[str]:
    """Share of `sets` data sets in which the nominal 95 % interval holds the truth, parameter by parameter."""
    inside: dict[str, list[np.ndarray]] = {}
    for index in range(sets):
        logs = made.logs(np.random.default_rng([index, 7]), episodes, 20)
        directions: dict[str, Any] = {"directions": made.directions} if given else {"rank": len(made.directions)}
        fit = pc.fit(logs, made.K, reaction=made.features, **directions)
        for name, (error, reach) in errors(made, fit).items():
            inside.setdefault(name, []).append(np.abs(error) <= reach)
    lines = []
    what = "given" if given else "estimated"
    for name, hits in inside.items():
        share = np.mean(hits, axis=0)
        outside = int(np.sum((share < 0.92) | (share > 0.98)))
        lines.append(
            f"| {made.kind}, n = {len(made.A)}, directions {what} | {name} | {len(share)} | {np.mean(share):.3f} | "
            f"{share.min():.3f} | {share.max():.3f} | {outside} |"
        )
    return lines
