"""What was aimed at, and whether the measured rows reach it."""

from collections.abc import Callable

from benchmarks.at_once import AT_ONCE
from benchmarks.gradients import BY_KERNEL
from benchmarks.measure import Row

FAMILIES = ("dense", "directional", "stock")
PRINTED = "(a) printed formula, NumPy"
DRAWN = "ours, draw, simulate and gradient, float64"


def goals_table(rows: list[Row], small: str, large: str) -> str:
    """The goals as Markdown; `small` and `large` name the shapes of the cases."""
    took = {(case, what): seconds for case, what, seconds, _ in rows}
    printed = {shape: took.get((f"dense, signs {shape}", PRINTED), 0.0) for shape in (small, large)}
    lines = ["| goal | at least | measured | met | by the kernel | met |", "|---|--:|--:|---|--:|---|"]

    def per_seed(law: str, shape: str, by: str) -> float | None:
        found = [s for (case, what), s in took.items() if case == f"dense, {law} {shape}" and _on_all_cores(what, by)]
        return printed[shape] / found[0] if found else None

    def add(goal: str, least: float | None, values: list[float | None]) -> None:
        shown = [f"{_times(v)} | {_said(v >= least)}" if v is not None and least else " | " for v in values]
        if least and values[0] is not None:
            lines.append(f"| {goal} | {least:.0f} × | {' | '.join(shown)} |")

    def both(value: Callable[[str], float | None]) -> list[float | None]:
        return [value(""), value(BY_KERNEL)]

    uniform = f"dense, uniform entries {small}"
    add(
        "one path, uniform entries, float64, of (a)",
        250,
        both(lambda by: printed[small] / took[uniform, DRAWN + by]),
    )
    add(
        "the same, called at once",
        250,
        both(lambda by: printed[small] / took[uniform, DRAWN + by + AT_ONCE]),
    )
    for law, least in (
        ("uniform entries", 850),
        ("uniform entries", 1300),
        ("normal entries", 1500),
        ("on a sphere", 1500),
    ):
        goal = f"a seed of many, {law}, float32, all cores, of (a)"
        add(goal, least, both(lambda by, law=law: per_seed(law, small, by)))

    def kept(by: str) -> float | None:
        """What is kept, at the large shape, of the factor at the small one."""
        at_large, at_small = (per_seed("uniform entries", shape, by) for shape in (large, small))
        return at_large / at_small if at_large and at_small else None

    add(f"the same with uniform entries at {large}, of what it is at {small}", 1, both(kept))
    for family in FAMILIES:
        exact = [s for (case, what), s in took.items() if case == f"{family} {small}" and what.startswith("exact cost")]
        add(f"exact cost and gradient, {family}, of reverse mode", 10, [exact[0] / exact[1], None])
    for family in FAMILIES:
        seconds = took[f"{family} {small}", "StablePoint, compiled"]
        lines.append(
            f"| StablePoint again, {family} | at most 4 ms | {1e3 * seconds:.1f} ms | {_said(seconds <= 4e-3)} | | |"
        )
    return "\n".join(lines)


def _on_all_cores(what: str, by: str) -> bool:
    on_all = "per seed" in what and what.endswith("cores") and "float32" in what and "default key" not in what
    return on_all and (BY_KERNEL in what) == bool(by)


def _times(value: float) -> str:
    return f"{value:.{0 if value >= 100 else 1}f} ×"


def _said(met: bool) -> str:
    return "yes" if met else "no"
