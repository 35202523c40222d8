"""From logs to a stable policy: what it costs in the true world, how often intervals of a decision hold the truth."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc
from benchmarks.plants import Plant, plant

EPISODES, HORIZON = 40, 20
MARGIN = 0.95  # growth of second moments at the stable policy of a plant that is counted


def world(made: Plant) -> dict[str, Any]:
    """Cost, horizon and feasible set."""
    n, m = made.B.shape
    cost = pc.QuadraticCost(np.eye(n), 0.1 * np.eye(m))
    return {"cost": cost, "horizon": HORIZON, "feasible_set": pc.FrobeniusBall(1.0)}


def plants() -> Iterator[tuple[int, Plant, pc.PerformativeProblem, jax.Array]]:
    """Plants with a stable policy in whose world second moments stay bounded, that policy, and the seed."""
    seed = 0
    while True:
        made = plant(seed)
        truth = made.problem(**world(made))
        solution = pc.solve(truth, pc.StablePoint(), throw=False)
        if solution.result == pc.Result.success and made.growth(np.asarray(solution.M)) < MARGIN:
            yield seed, made, truth, solution.M
        seed += 1


def end_to_end(systems: int, directions: str, reaction: Any = "auto") -> list[str]:
    """Excess cost in the true world of the stable policy of the fit, relative to the plant's own."""
    excess, naive, solved = [], [], 0
    for _, (seed, made, truth, M) in zip(range(systems), plants(), strict=False):
        logs = made.logs(np.random.default_rng([seed, 3]), EPISODES, HORIZON)
        given = made.directions if directions == "given" else None
        fit = pc.fit(logs, made.K, directions=given, reaction=made.features if reaction == "given" else reaction)
        solution = pc.solve(fit.problem(**world(made)), pc.StablePoint(), throw=False)
        solved += bool(solution.result == pc.Result.success)
        best = float(pc.expected_cost(truth, M))
        excess.append(abs(float(pc.expected_cost(truth, solution.M)) / best - 1))
        still = pc.best_response(truth, jnp.zeros_like(M))
        naive.append(abs(float(pc.expected_cost(truth, still)) / best - 1))
    shown = [f"{100 * value:.2f} %" for value in (*np.quantile(excess, [0.5, 0.9, 1.0]), np.median(naive))]
    return [f"| {directions} | {reaction} | {systems} | {solved} | " + " | ".join(shown) + " |"]


def ensembles(systems: int, repeats: int, k: int, level: float, reaction: Any) -> list[str]:
    """How often the intervals of `Fit.decide` hold the truth."""
    hits: dict[str, list[float]] = {"cost": [], "deployed_cost": [], "policy": []}
    certified = []
    for _, (seed, made, truth, M) in zip(range(systems), plants(), strict=False):
        for repeat in range(repeats):
            logs = made.logs(np.random.default_rng([seed, 4, repeat]), EPISODES, HORIZON)
            fit = pc.fit(logs, made.K, directions=made.directions, reaction=reaction or made.features)
            decision = fit.decide(k, key=jax.random.key(repeat), level=level, **world(made))
            truths = {
                "cost": pc.expected_cost(truth, M),
                "deployed_cost": pc.expected_cost(truth, decision.M),
                "policy": M,
            }
            for name, value in truths.items():
                interval = getattr(decision, name)
                inside = (interval.low <= np.asarray(value)) & (np.asarray(value) <= interval.high)
                hits[name].append(float(np.mean(inside)))
            certified.append(decision.certified)
    cases = systems * repeats
    return [
        f"| {reaction or 'given'} | {cases} | {k} | {100 * level:g} % | "
        + " | ".join(f"{100 * np.mean(hits[name]):.1f} %" for name in ("cost", "deployed_cost", "policy"))
        + f" | {100 * np.mean(certified):.1f} % |"
    ]
