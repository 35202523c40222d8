"""How often `pc.test_reaction` rejects: where nothing reacts, and where one deployment is five standard errors off."""

from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np

import perfcontrol as pc
from benchmarks.plants import Plant, plant

EPISODES, HORIZON = 40, 10
MORE_EPISODES = 100  # with 40, no change of the perturbations is five of its standard errors, which grow with it
FLIPS = 199
PILOTS = 15
LEVEL = 0.05


def _tested(made: Plant, seed: list[int], worlds: list[Plant], episodes: int = EPISODES) -> pc.ReactionTest:
    logs = made.logs(np.random.default_rng(seed), episodes, HORIZON, worlds)
    return pc.test_reaction(logs, made.K, permutations=FLIPS, key=jax.random.key(seed[0]))


def levels(sets: int, systems: int) -> list[str]:
    """Rejections among data sets without a reaction, the systems in turn."""
    rejected: dict[int, list[bool]] = {}
    for index in range(sets):
        made = plant(index % systems)
        p = _tested(made, [index, 1], [made.frozen()] * len(made.policies)).p_value
        rejected.setdefault(len(made.A), []).append(p is not None and p <= LEVEL)
    lines = ["| states | data sets | rejected at 5 % | share |", "| --- | --- | --- | --- |"]
    whole = [hit for hits in rejected.values() for hit in hits]
    for name, hits in [*sorted(rejected.items()), ("all", whole)]:
        lines.append(f"| {name} | {len(hits)} | {sum(hits)} | {100 * np.mean(hits):.1f} % |")
    return lines


def _shifts(made: Plant) -> dict[str, Callable[[float], Plant]]:
    """Worlds that differ from the frozen one by a size, part by part; the size enters linearly."""
    calm, entry = made.frozen(), np.zeros_like(made.A)
    entry[0, 1] = 1.0
    return {
        "mean": lambda size: replace(calm, A=calm.A + size * entry),
        "perturbation": lambda size: replace(calm, scale=calm.scale * np.sqrt(1 + size)),
        "noise": lambda size: replace(calm, noise=calm.noise * (1 + size)),
    }


def _in_errors(result: pc.ReactionTest, part: str) -> float:
    """The estimated shift of the second deployment in its standard errors."""
    estimate = result.effect[part].by_deployment
    value, error = (np.asarray(x)[1] for x in (estimate.mean, estimate.standard_error))
    return float((value / error)[0, 1] if part == "mean" else value / error)


def power(sets: int, states: tuple[int, ...]) -> list[str]:
    """Rejections where the second of five deployments differs in one part by five standard errors."""
    lines = [
        "| states | what differs | its mean estimate, in standard errors | rejected | share |",
        "| --- | --- | --- | --- | --- |",
    ]
    for n in states:
        made = plant(n, n, "norm")
        for part, shifted in _shifts(made).items():

            def run(size: float, seeds: range, made: Plant = made, part: str = part, shifted=shifted) -> list:
                worlds = [made.frozen()] * len(made.policies)
                worlds[1] = shifted(size)
                tests = [_tested(made, [seed, 2], worlds, MORE_EPISODES) for seed in seeds]
                return [(_in_errors(test, part), test.p_value) for test in tests]

            size = 0.3
            for _ in range(6):  # until the mean estimate is five of its standard errors
                seen = run(size, range(1000, 1000 + PILOTS))
                size *= 5 / float(np.mean([shift for shift, _ in seen]))
            found = run(size, range(sets))
            hits = [p <= LEVEL for _, p in found]
            mean = np.mean([shift for shift, _ in found])
            lines.append(f"| {n} | {part} | {mean:.2f} | {sum(hits)} of {sets} | {100 * np.mean(hits):.1f} % |")
    return lines
