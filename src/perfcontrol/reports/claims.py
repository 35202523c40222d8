"""A claim with the statistic that decides it, and the tables that list claims."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

Verdict = Literal["holds", "holds as completed", "does not hold"]


class Claim(NamedTuple):
    """One statement and what the data say of it.

    interval: of the statistic over seeds (95 % bootstrap or Wilson), or the statistic twice where nothing is random.
    verdict: follows from the numbers by `rule`. detail: what happens, in words and numbers.
    """

    claim: str
    source: str
    statistic: str
    value: float
    interval: tuple[float, float]
    rule: str
    verdict: Verdict
    detail: str

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**self._asdict(), "interval": list(self.interval)}


def bootstrap(
    samples: np.ndarray, statistic: Any, count: int = 500, level: float = 0.95, seed: int = 0
) -> tuple[float, tuple[float, float]]:
    """A statistic of rows (seed, ...) and its percentile interval over resampled seeds."""
    generator = np.random.default_rng(seed)
    draws = [statistic(samples[generator.integers(0, len(samples), len(samples))]) for _ in range(count)]
    tail = 50 * (1 - level)
    low, high = np.percentile(draws, [tail, 100 - tail])
    return float(statistic(samples)), (float(low), float(high))


def median(rows: np.ndarray) -> Any:
    """Medians over the first axis: the middle of what sorting gives, which beats selecting where rows are few."""
    ordered = np.sort(rows, axis=0)
    return (ordered[(len(rows) - 1) // 2] + ordered[len(rows) // 2]) / 2


def wilson(successes: int, trials: int) -> tuple[float, tuple[float, float]]:
    """A share and its 95 % Wilson interval."""
    z = 1.959963984540054
    share = successes / trials
    centre = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * np.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    return share, (float(max(centre - half, 0.0)), float(min(centre + half, 1.0)))


def loglog_slope(steps: np.ndarray, values: np.ndarray) -> float:
    """Least-squares slope of log values against log steps."""
    across = np.log(steps) - np.mean(np.log(steps))
    return float(across @ np.log(values) / (across @ across))


def as_markdown(claims: Sequence[Claim], settings: Mapping[str, Any]) -> str:
    """The table of claims, one row each, with what was found below."""
    lines = [
        "# Claims of the paper's numerical section, checked",
        "",
        "Every verdict is computed from the runs by the rule given with it. *Holds as completed* names what had to be",
        "added to the paper's text. Intervals are over seeds (95 %): bootstrap, or Wilson for shares.",
        "",
        "Settings: " + ", ".join(f"{key} = {value}" for key, value in settings.items()) + ".",
        "",
        "| # | Claim | Source | Statistic | Value | Interval | Verdict |",
        "|--:|---|---|---|--:|---|---|",
    ]
    for number, claim in enumerate(claims, 1):
        low, high = claim.interval
        lines.append(
            f"| {number} | {claim.claim} | {claim.source} | {claim.statistic} | {claim.value:.3g} "
            f"| [{low:.3g}, {high:.3g}] | **{claim.verdict}** |"
        )
    lines += ["", "## What was found", ""]
    for number, claim in enumerate(claims, 1):
        lines.append(f"{number}. **{claim.verdict}** ({claim.rule}). {claim.detail}")
    return "\n".join(lines) + "\n"
