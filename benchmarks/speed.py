"""Speed side by side in one process: NumPy baselines, ours on one path and on many, exact evaluation, stable points.

Times are medians of repeated calls of compiled programs, compilation listed apart. Ratios are against the printed
formula in NumPy on the same path. Random numbers are drawn from fast keys unless a row says otherwise. The last rows
give what the machine can do, and how much of it is used.
"""

import jax

import perfcontrol as pc
from benchmarks import at_once
from benchmarks.evaluation import exact_rows, stable_rows, sweep_rows
from benchmarks.goals import goals_table
from benchmarks.gradients import gradient_rows, kernel_rows, lane_rows, sampled_rows, seed_rows
from benchmarks.limits import machine_rows, scaling_rows
from benchmarks.measure import Row, as_markdown
from benchmarks.problems import SHAPES, policy_of, problem_of
from perfcontrol.experiments.batches import in_single_precision

LAWS = {"uniform": "uniform entries", "gaussian": "normal entries", "sphere": "on a sphere"}
SMALL, LARGE = "(20, 1, 60)", "(100, 5, 100)"


def table(quick: bool) -> str:
    """The goals and all rows, as Markdown."""
    rows: list[Row] = []
    printed: dict[str, float] = {}
    for name, shape in SHAPES.items():
        if not quick or name == SMALL:
            some, printed[name] = gradient_rows(f"dense, signs {name}", problem_of(*shape))
            rows += some
    laws = [(law, kind, name) for name in (SMALL, LARGE) if name in printed for law, kind in LAWS.items()]
    for law, kind, name in laws:
        rows += sampled_rows(f"dense, {kind} {name}", problem_of(*SHAPES[name], law=law), printed[name])
    uniform = in_single_precision(problem_of(20, 1, 60, law="uniform"))
    M = policy_of(uniform)
    rows += seed_rows(
        f"dense, uniform entries {SMALL}", "float32, JAX's default key", uniform, M, printed[SMALL], jax.random.key(3)
    )
    rows += lane_rows(f"dense, uniform entries {SMALL}", "float32", uniform, M, printed[SMALL])
    pc.use_kernel()
    for law, kind, name in laws:
        rows += kernel_rows(f"dense, {kind} {name}", problem_of(*SHAPES[name], law=law), printed[name])
    pc.use_kernel(False)
    rows += at_once.rows(f"dense, uniform entries {SMALL}")
    directional, stock = problem_of(20, 1, 60, "directional"), pc.experiments.stock_market("random")
    families = {"dense": problem_of(20, 1, 60), "directional": directional, "stock": stock}
    for kind in ("directional", "stock"):
        rows += sampled_rows(f"{kind} {SMALL}", families[kind], printed[SMALL])
    for kind, problem in families.items():
        rows += exact_rows(f"{kind} {SMALL}", problem)
    for kind, problem in families.items():
        rows += stable_rows(f"{kind} {SMALL}", problem)
    rows += sweep_rows()
    rows += scaling_rows()
    best = min(t for case, what, t, _ in rows if case == f"dense, signs {SMALL}" and what.endswith("float32, one core"))
    rows += machine_rows(best)
    return goals_table(rows, SMALL, LARGE) + "\n\n" + as_markdown(rows)
