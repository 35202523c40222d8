"""The worlds of the slider: one plant, three ways to react; numbers for the page, and the picture that stands for it.

    python docs/worlds.py

writes `docs/assets/worlds-data.js` and `docs/img/worlds.png`. The policy is one number, how hard to push back against
the last shock, so that C(M; M') is a parabola in M for every world M'. Three costs give its coefficients, and a page
can draw any of them.
"""

import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import perfcontrol as pc
from perfcontrol.plotting.style import styled

DOCS = Path(__file__).parent
LOW, HIGH, STEP = -0.25, 1.35, 0.01
SHOWN = {0.0: (-0.15, 50), 0.4: (0.1, 54.5), 0.99: (0.49, 54.5)}  # worlds; where their names stand


class Reaction(NamedTuple):
    """What share of a shock is left after a period: `share` + `slope` M'."""

    name: str
    share: float
    slope: float


REACTIONS = (
    Reaction("Nobody reacts", 0.6, 0.0),
    Reaction("Others join in", 0.5, 0.5),
    Reaction("Others hold back", 0.8, -1.5),
)


def problem_of(reaction: Reaction) -> pc.PerformativeProblem:
    """x' = (share + slope M' + 0.1 ζ) x - u + w with u = M w_before: shocks last longer where others join in."""
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[reaction.share]], [[-1.0]]),
        horizon=30,
        noise=pc.Rademacher([1.0]),
        cost=pc.QuadraticCost([[1.0]], [[0.1]]),
        perturbation=pc.DirectionalPerturbation(
            np.eye(1)[None], [0.1], mean=pc.Affine(np.zeros((1, 1)), np.full((1, 1, 1, 1, 1), reaction.slope))
        ),
    )


def describe(reaction: Reaction) -> dict:
    """Coefficients of C(M; M') = a + b M + c M² on the grid of worlds, and the policies that matter."""
    problem = problem_of(reaction)
    worlds = np.arange(round(LOW / STEP), round(HIGH / STEP) + 1) * STEP

    def costs(world):
        return jnp.stack([pc.expected_cost(problem, M, deployed=as_policy(world)) for M in map(as_policy, (-1, 0, 1))])

    below, middle, above = jax.jit(jax.vmap(costs))(worlds).T
    price = pc.price_of_stability(problem)
    at = {name: float(getattr(price, name).squeeze()) for name in ("naive", "stable", "optimal")}
    return {
        "name": reaction.name,
        "share": reaction.share,
        "slope": reaction.slope,
        "a": rounded(middle),
        "b": rounded((above - below) / 2),
        "c": rounded((above + below) / 2 - middle),
        "policies": {name: [round(M, 6), round(getattr(price, f"cost_{name}"), 4)] for name, M in at.items()},
        "rate": round(float(pc.certify(problem, pc.Sharp(samples=0, pairs=0)).rate), 4),
    }


def as_policy(M):
    """One number as a policy."""
    return jnp.full((1, 1, 1), M)


def rounded(values):
    """To seven figures: less than a pixel."""
    return [float(f"{value:.7g}") for value in values]


def draw(described: dict, path: Path) -> None:
    """What the slider shows, at three of its places."""
    worlds = np.arange(round(LOW / STEP), round(HIGH / STEP) + 1) * STEP
    a, b, c = (np.array(described[name]) for name in "abc")
    with styled():
        figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained")
        own = a + b * worlds + c * worlds**2
        axes.plot(worlds, own, color="#222222", linewidth=2)
        axes.text(-0.22, 37.2, "each policy in\nits own world", va="center")
        for (world, place), red in zip(SHOWN.items(), ("#E6B0AA", "#D98880", "#C0392B"), strict=True):
            i = int(np.argmin(np.abs(worlds - world)))
            best = -b[i] / (2 * c[i])
            axes.plot(worlds, a[i] + b[i] * worlds + c[i] * worlds**2, color=red, linewidth=1.2, zorder=1)
            axes.plot(world, own[i], "o", color=red, markersize=5)
            axes.plot(best, a[i] - b[i] ** 2 / (4 * c[i]), "v", color=red, markersize=5)
            axes.text(*place, f"world of {world:g}", color="#C0392B")
        for name, marker, colour, shift in (("stable", "o", "#C0392B", (9, -5)), ("optimal", "*", "#0072B2", (-6, 8))):
            M, cost = described["policies"][name]
            axes.plot(M, cost, marker, color=colour, markersize=9, markeredgecolor="white", zorder=5)
            align = "left" if name == "stable" else "right"
            axes.annotate(f"{name}: {cost:.1f}", (M, cost), shift, textcoords="offset points", color=colour, ha=align)
        axes.set(xlim=(LOW, HIGH), ylim=(30, 60), xlabel="policy M: how hard to push back", ylabel="expected cost")
        figure.savefig(path, dpi=220)
        plt.close(figure)


def main() -> None:
    """Write both files."""
    data = {"low": LOW, "high": HIGH, "step": STEP, "reactions": [describe(reaction) for reaction in REACTIONS]}
    (DOCS / "assets" / "worlds-data.js").write_text(f"const WORLDS = {json.dumps(data)};\n", encoding="utf-8")
    draw(data["reactions"][1], DOCS / "img" / "worlds.png")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    matplotlib.use("agg")
    main()
