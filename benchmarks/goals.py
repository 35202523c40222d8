"""What was aimed at, and whether the measured rows reach it."""

from benchmarks.measure import Row

FAMILIES = ("dense", "directional", "stock")
PRINTED = "(a) printed formula, NumPy"
DRAWN = "ours, draw, simulate and gradient, float64"


def goals_table(rows: list[Row], small: str, large: str) -> str:
    """The goals as Markdown; `small` and `large` name the shapes of the cases."""
    took = {(case, what): seconds for case, what, seconds, _ in rows}
    printed = {shape: took.get((f"dense, signs {shape}", PRINTED), 0.0) for shape in (small, large)}

    def per_seed(law: str, shape: str) -> float | None:
        found = [s for (case, what), s in took.items() if case == f"dense, {law} {shape}" and _on_all_cores(what)]
        return printed[shape] / found[0] if found else None

    uniform, at_large = per_seed("uniform entries", small), per_seed("uniform entries", large)
    lines = ["| goal | at least | measured | met |", "|---|--:|--:|---|"]

    def add(goal: str, least: float, value: float | None) -> None:
        if value is not None:
            lines.append(
                f"| {goal} | {least:.0f} × | {value:.{0 if value >= 100 else 1}f} × | {_said(value >= least)} |"
            )

    add(
        "one path, uniform entries, float64, of (a)",
        250,
        printed[small] / took[f"dense, uniform entries {small}", DRAWN],
    )
    for law, least in (
        ("uniform entries", 850),
        ("uniform entries", 1300),
        ("normal entries", 1500),
        ("on a sphere", 1500),
    ):
        add(f"a seed of many, {law}, float32, all cores, of (a)", least, per_seed(law, small))
    if uniform is not None:
        add(f"the same with uniform entries at {large}, as at {small}", uniform, at_large)
    for family in FAMILIES:
        exact = [s for (case, what), s in took.items() if case == f"{family} {small}" and what.startswith("exact cost")]
        add(f"exact cost and gradient, {family}, of reverse mode", 10, exact[0] / exact[1])
    for family in FAMILIES:
        seconds = took[f"{family} {small}", "StablePoint, compiled"]
        lines.append(
            f"| StablePoint again, {family} | at most 4 ms | {1e3 * seconds:.1f} ms | {_said(seconds <= 4e-3)} |"
        )
    return "\n".join(lines)


def _on_all_cores(what: str) -> bool:
    return "per seed" in what and what.endswith("cores") and "float32" in what and "default key" not in what


def _said(met: bool) -> str:
    return "yes" if met else "no"
