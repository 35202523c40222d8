"""Runs the case studies of `examples/`, puts what they print into their pages, and draws their figures.

python docs/cases.py
"""

import io
import re
import runpy
from contextlib import redirect_stdout
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt

from perfcontrol.plotting.style import styled

DOCS = Path(__file__).parent
CASES = {
    "stock-market": "stock_market",
    "traffic": "traffic",
    "tariff": "tariff",
    "ride-prices": "ride_prices",
}
PRINTED = re.compile(r"(?<=^```text\n).*?(?=^```)", re.MULTILINE | re.DOTALL)
FOLD = 50  # from this ratio on costs are drawn on a logarithmic axis
COLOURS = {"naive": "#E69F00", "stable": "#C0392B", "optimal": "#0072B2"}


def run(case: str, quick: bool = False) -> tuple[object, str]:
    """What an example returns, and what it prints."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        found = runpy.run_path(str(DOCS.parent / "examples" / f"{CASES[case]}.py"))["main"](quick=quick)
    return found, printed.getvalue()


def label(axes, value: float, y: float) -> None:
    """The number beside its bar."""
    figures = f"{value:,.0f}".replace(",", " ") if value >= 100 else f"{value:.3g}"
    axes.annotate(figures, (value, y), (4, 0), textcoords="offset points", va="center")


def bars(axes, costs: dict[str, float]) -> None:
    """Costs once deployed, one bar a policy."""
    for i, (name, cost) in enumerate(costs.items()):
        axes.barh(-i, cost, color=COLOURS.get(name, "#999999"), height=0.6)
        label(axes, cost, -i)
    axes.set_yticks([-i for i in range(len(costs))], list(costs))
    if max(costs.values()) > FOLD * min(costs.values()):
        axes.set_xscale("log")
        axes.set_xlim(min(costs.values()) / 2, max(costs.values()) * 6)
    axes.margins(x=0.25)
    axes.grid(False, axis="y")
    axes.set_xlabel("expected cost, once deployed")


def rounds_of_retraining(axes, rounds: list[float], costs: dict[str, float]) -> None:
    """Cost after each round, beside those of the stable and the optimal policy."""
    axes.plot(rounds, "o-", color="#222222", markersize=4)
    axes.axhline(costs["stable"], color=COLOURS["stable"], label="stable", linewidth=1.2)
    axes.axhline(costs["optimal"], color=COLOURS["optimal"], label="optimal", linewidth=1.2, linestyle="--")
    if max(rounds) > FOLD * min(costs.values()):
        axes.set_yscale("log")
    else:
        axes.set_ylim(0, None)
    axes.set_xlabel("rounds of retraining")
    axes.legend()


def linear_and_true(axes, costs: dict[str, tuple[float, float]]) -> None:
    """What the linear system says, beside what the map itself gives."""
    for i, (name, (linear, true)) in enumerate(costs.items()):
        colour = COLOURS.get(name, "#999999")
        axes.barh(-i + 0.18, linear, color=colour, height=0.34)
        axes.barh(-i - 0.18, true, color=colour, height=0.34, alpha=0.5)
        label(axes, linear, -i + 0.18)
        label(axes, true, -i - 0.18)
    axes.set_yticks([-i for i in range(len(costs))], list(costs))
    axes.margins(x=0.15)
    axes.grid(False, axis="y")
    axes.set_xlabel("expected cost: of the linear system (full), with true riders (pale)")


def draw(case: str, found) -> None:
    """The figure of a case."""
    with styled():
        if case == "ride-prices":
            figure, axes = plt.subplots(figsize=(5.6, 2.3), layout="constrained")
            linear_and_true(axes, found)
        else:
            figure, (left, right) = plt.subplots(1, 2, figsize=(5.6, 2.3), layout="constrained")
            bars(left, found[0])
            rounds_of_retraining(right, found[1], found[0])
        figure.savefig(DOCS / "img" / f"case-{case}.png", dpi=200)
        plt.close(figure)


def main() -> None:
    """Pages and figures of all cases."""
    for case in CASES:
        found, printed = run(case)
        draw(case, found)
        page = DOCS / "cases" / f"{case}.md"
        page.write_text(PRINTED.sub(lambda _, text=printed: text, page.read_text("utf-8"), count=1), "utf-8")


if __name__ == "__main__":
    matplotlib.use("agg")
    main()
