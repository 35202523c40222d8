"""Speed side by side in one process: NumPy baselines, ours on one path and on many, exact evaluation, stable points.

Times are medians of repeated calls of compiled programs, compilation listed apart. Ratios are against the printed
formula in NumPy on the same path. The last rows give what the machine can do, and how much of it is used.
"""

import perfcontrol as pc
from benchmarks.evaluation import exact_rows, stable_rows, sweep_rows
from benchmarks.gradients import gradient_rows, lane_rows, seed_rows
from benchmarks.limits import machine_rows, scaling_rows
from benchmarks.measure import Row, as_markdown
from benchmarks.problems import SHAPES, policy_of, problem_of
from perfcontrol.experiments.batches import in_single_precision


def table(quick: bool) -> str:
    """The whole table as Markdown."""
    rows: list[Row] = []
    for name, shape in SHAPES.items():
        if quick and name == "(100, 5, 100)":
            continue
        rows += gradient_rows(f"dense {name}", problem_of(*shape))
    rows += gradient_rows("directional (20, 1, 60)", problem_of(20, 1, 60, "directional"))
    stock = pc.experiments.stock_market("random")
    dense_best = next(
        t for case, what, t, _ in rows if case == "dense (20, 1, 60)" and what.endswith("float32, one core")
    )
    printed = next(t for case, what, t, _ in rows if case == "dense (20, 1, 60)" and "(a)" in what)
    # A sign costs a bit of a random word, a uniform entry a whole one.
    uniform = problem_of(20, 1, 60, law="uniform")
    batched = {"dense": problem_of(20, 1, 60), "dense, uniform entries": uniform, "stock": stock}
    for kind, problem in batched.items():
        name, M = f"{kind} (20, 1, 60)", policy_of(problem)
        for label, p in (("float64", problem), ("float32", in_single_precision(problem))):
            if kind != "dense":  # which is above
                rows += seed_rows(name, label, p, M.astype(p.dtype), printed)
            rows += lane_rows(name, label, p, M.astype(p.dtype), printed)
    for kind in ("dense", "directional"):
        rows += exact_rows(f"{kind} (20, 1, 60)", problem_of(20, 1, 60, kind))
    rows += exact_rows("stock (20, 1, 60)", stock)
    for kind in ("dense", "directional"):
        rows += stable_rows(f"{kind} (20, 1, 60)", problem_of(20, 1, 60, kind))
    rows += stable_rows("stock (20, 1, 60)", stock)
    rows += sweep_rows()
    rows += scaling_rows()
    rows += machine_rows(dense_best)
    return as_markdown(rows)
