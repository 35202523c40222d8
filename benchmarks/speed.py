"""Speed side by side in one process: NumPy baselines, ours on one path and on many, exact evaluation, stable points.

Times are medians of repeated calls of compiled programs, compilation listed apart. Ratios are against the printed
formula in NumPy on the same path. The last rows give what the machine can do, and how much of it is used.
"""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

import perfcontrol as pc
from benchmarks import numpy_gradients
from perfcontrol.evaluate.adjoint import mean_path_gradient, path_gradient
from perfcontrol.evaluate.cost_to_go import cost_to_go
from perfcontrol.evaluate.exact import cost_and_gradient, exact_cost
from perfcontrol.evaluate.moments import cost_by_moments
from perfcontrol.evaluate.rollout import lanes, sample_path
from perfcontrol.experiments.batches import in_single_precision

SHAPES = {"(20, 1, 60)": (20, 1, 60), "(4, 10, 200)": (4, 10, 200), "(100, 5, 100)": (100, 5, 100)}  # n = m, H, T
SEEDS = 288
Row = tuple[str, str, float, str]


def problem_of(n: int, H: int, T: int, kind: str = "dense") -> pc.PerformativeProblem:
    """A stable closed loop with dense or directional perturbations that react to the policy."""
    r = np.random.default_rng(n + T)
    A = r.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    if kind == "dense":
        perturbation = pc.DensePerturbation(lambda M: 0.1 / n * jnp.sqrt(1 + jnp.sum(M**2) / n), law="rademacher")
    else:
        directions = r.standard_normal((2, n, n)) / n
        perturbation = pc.DirectionalPerturbation(
            directions, lambda M: 0.1 * jnp.sqrt(1 + jnp.sum(M**2) / n) * jnp.ones(2)
        )
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, r.standard_normal((n, n)) / np.sqrt(n)),
        horizon=T,
        memory=H,
        gain=0.01 * r.standard_normal((n, n)),
        noise=pc.Rademacher(np.ones(n)),
        cost=pc.QuadraticCost(np.eye(n), 0.1 * np.eye(n)),
        perturbation=perturbation,
    )


def median_time(call: Callable[[], Any], least: float = 0.3, most: int = 200) -> float:
    """Median seconds of a call, over at least five calls and about `least` seconds."""
    times: list[float] = []
    while len(times) < 5 or (sum(times) < least and len(times) < most):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def compiled(function: Callable, *arguments: Any) -> tuple[Callable[[], Any], float]:
    """A call of the compiled function on fixed arguments, and the seconds that compilation took."""
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    began = time.perf_counter()
    program = jax.jit(lambda leaves: function(*eqx.combine(leaves, static))).lower(dynamic).compile()
    return lambda: program(dynamic), time.perf_counter() - began


def _policy(problem: pc.PerformativeProblem) -> jax.Array:
    raw = 0.05 * jax.random.normal(jax.random.key(0), problem.policy_shape, problem.dtype)
    return problem.feasible_set.project(raw)


def batch_gradients(problem: pc.PerformativeProblem, M: jax.Array, keys: jax.Array) -> jax.Array:
    """A sampled path gradient for every key, on one core."""
    return jax.lax.map(lambda key: mean_path_gradient(problem, M, M, key, 1), keys, batch_size=lanes(problem))


def gradients_on_all_cores(problem: pc.PerformativeProblem, M: jax.Array, keys: jax.Array) -> jax.Array:
    """The same, the keys shared out over the host's cores."""
    mesh = Mesh(np.array(jax.devices()), ("keys",))
    spread = jax.shard_map(
        lambda keys: batch_gradients(problem, M, keys), mesh=mesh, in_specs=P("keys"), out_specs=P("keys"),
        check_vma=False,
    )  # fmt: skip
    return spread(keys)


def seed_rows(name: str, label: str, problem: pc.PerformativeProblem, M: jax.Array, printed: float) -> list[Row]:
    """Seconds per seed of `SEEDS`, on one core and on all."""
    rows: list[Row] = []
    keys = jax.random.split(jax.random.key(3), SEEDS)
    for function, where in ((batch_gradients, "one core"), (gradients_on_all_cores, f"{len(jax.devices())} cores")):
        call, build = compiled(function, problem, M, keys)
        took = median_time(call) / SEEDS
        note = f"{printed / took:.0f} (compiled in {build:.1f} s)"
        rows.append((name, f"ours, the same per seed of {SEEDS}, {label}, {where}", took, note))
    return rows


def numpy_baselines(problem: pc.PerformativeProblem, M: jax.Array) -> tuple[float, float]:
    """Seconds of (a) and (b) on one path; both are checked against ours first."""
    path = sample_path(problem, problem.lift(M), problem.lift(M), jax.random.key(1))
    by_state, by_input = problem.cost.path_gradients(path.x, path.u)
    arrays = (problem.system.A, problem.system.B, problem.gain, path.draws.dense(), path.x, path.w)
    host = [np.asarray(array, float) for array in arrays]
    rest = (problem.memory, np.asarray(by_state), np.asarray(by_input))
    ours = np.asarray(path_gradient(problem, path))
    flat = np.concatenate(list(ours), axis=1)
    np.testing.assert_allclose(numpy_gradients.printed(*host, *rest), flat, rtol=1e-8, atol=1e-8 * np.abs(flat).max())
    np.testing.assert_allclose(numpy_gradients.adjoint(*host, *rest), ours, rtol=1e-8, atol=1e-8 * np.abs(flat).max())
    slow = median_time(lambda: numpy_gradients.printed(*host, *rest))
    return slow, median_time(lambda: numpy_gradients.adjoint(*host, *rest))


def gradient_rows(name: str, problem: pc.PerformativeProblem) -> list[Row]:
    """NumPy against ours, one path and many seeds, both precisions."""
    M = _policy(problem)
    printed, adjoint = numpy_baselines(problem, M)
    rows: list[Row] = [
        (name, "(a) printed formula, NumPy", printed, "1"),
        (name, "(b) adjoint, NumPy", adjoint, f"{printed / adjoint:.1f}"),
    ]
    for label, p in (("float64", problem), ("float32", in_single_precision(problem))):
        policy = M.astype(p.dtype)
        path = sample_path(p, p.lift(policy), p.lift(policy), jax.random.key(1))
        call, build = compiled(path_gradient, p, path)
        took = median_time(call)
        rows.append(
            (name, f"ours, gradient of a path, {label}", took, f"{printed / took:.0f} (compiled in {build:.1f} s)")
        )
        call, build = compiled(lambda p, M, key: mean_path_gradient(p, M, M, key, 1), p, policy, jax.random.key(2))
        took = median_time(call)
        rows.append(
            (
                name,
                f"ours, draw, simulate and gradient, {label}",
                took,
                f"{printed / took:.0f} (compiled in {build:.1f} s)",
            )
        )
        rows += seed_rows(name, label, p, policy, printed)
    return rows


def exact_rows(name: str, problem: pc.PerformativeProblem) -> list[Row]:
    """Exact cost and gradient by the cost-to-go form against reverse mode through the moment recursion."""
    M = _policy(problem)

    def ours(p: pc.PerformativeProblem, M: jax.Array) -> Any:
        return cost_and_gradient(p, cost_to_go(p, p.structure.lift(M)), p.structure.lift(M))

    call, build = compiled(ours, problem, M)
    took = median_time(call)
    reverse, _ = compiled(lambda p, M: jax.value_and_grad(lambda v: cost_by_moments(p, v, M))(M), problem, M)
    slow = median_time(reverse)
    return [
        (name, "exact cost and gradient, reverse mode through moments", slow, ""),
        (name, "exact cost and gradient, ours", took, f"{slow / took:.1f} times faster (compiled in {build:.1f} s)"),
    ]


def stable_rows(name: str, problem: pc.PerformativeProblem) -> list[Row]:
    """A stable point, first call (with compilation) and after."""
    began = time.perf_counter()
    pc.solve(problem, pc.StablePoint())
    first = time.perf_counter() - began
    took = median_time(lambda: pc.solve(problem, pc.StablePoint()).M)
    return [(name, "StablePoint, compiled", took, f"first call {first:.1f} s")]


def sweep_rows(count: int = 20) -> list[Row]:
    """Problems that differ in a parameter of a policy map: all but the first reuse what was compiled."""
    base = problem_of(20, 1, 60, "directional")
    scale = pc.Function(lambda M, p: p * jnp.sqrt(1 + jnp.sum(M**2) / 20) * jnp.ones(2), 0.1)
    base = eqx.tree_at(lambda p: p.perturbation, base, pc.DirectionalPerturbation(base.perturbation.directions, scale))

    def work(strength: float) -> None:
        problem = eqx.tree_at(lambda p: p.perturbation.scale.params, base, jnp.asarray(strength))
        M = pc.solve(problem, pc.StablePoint()).M
        pc.expected_cost(problem, M).block_until_ready()

    began = time.perf_counter()
    work(0.1)
    first = time.perf_counter() - began
    began = time.perf_counter()
    for index in range(1, count):
        work(0.1 + 0.005 * index)
    rest = time.perf_counter() - began
    note = f"the first took {first:.1f} s"
    return [("directional (20, 1, 60)", f"stable point and its cost, {count - 1} further swept problems", rest, note)]


def exponent(sizes: list[int], times: list[float]) -> float:
    """Slope of log time against log size."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def scaling_rows() -> list[Row]:
    """Exponents of the path gradient in T, n, H and the batch, by doubling from a size where work dominates."""
    grids: dict[str, list[tuple[int, int, int, int]]] = {  # n, H, T, seeds
        "T": [(20, 1, T, 32) for T in (60, 240, 960)],
        "n": [(n, 1, 60, 32) for n in (16, 32, 64)],
        "H": [(10, H, 60, 32) for H in (1, 4, 16)],
        "seeds": [(20, 1, 60, S) for S in (32, 128, 512)],
    }
    position = {"T": 2, "n": 0, "H": 1, "seeds": 3}
    rows: list[Row] = []
    for axis, grid in grids.items():
        times = []
        for n, H, T, seeds in grid:
            problem = problem_of(n, H, T, "directional")
            keys = jax.random.split(jax.random.key(0), seeds)
            times.append(median_time(compiled(batch_gradients, problem, _policy(problem), keys)[0]))
        value = exponent([case[position[axis]] for case in grid], times)
        rows.append((f"exponent in {axis}", "sampled gradient, directional, float64", times[-1], f"{value:.2f}"))
    times, horizons = [], [60, 240, 960]
    for T in horizons:
        problem = problem_of(20, 1, T, "directional")
        times.append(median_time(compiled(exact_cost, problem, _policy(problem), _policy(problem))[0]))
    rows.append(("exponent in T", "exact cost, directional, float64", times[-1], f"{exponent(horizons, times):.2f}"))
    return rows


def machine_rows(best: float) -> list[Row]:
    """What the machine can do: matrix products, memory, random numbers; and the share that a path gradient uses."""
    n = 1024
    a = jnp.ones((n, n), jnp.float32)
    product = median_time(compiled(lambda a: a @ a, a)[0])
    flops = 2 * n**3 / product
    source, target = np.ones(2**25, np.float32), np.zeros(2**25, np.float32)
    moved = median_time(lambda: np.copyto(target, source))
    numbers = 2**20
    drawn = median_time(compiled(lambda key: jax.random.uniform(key, (numbers,), jnp.float32), jax.random.key(0))[0])
    # A dense path draws a sign for every entry of 60 matrices, 32 from one word.
    share_drawn = f"{100 * 60 * 20 * 20 / 32 * drawn / numbers / best:.0f} % of a dense path's time is words of signs"
    work = 2 * 60 * (2 * 2 * 20 * 20)  # multiply-adds of two matrix products a step, forward and backward
    return [
        (
            "machine",
            f"float32 matrix product, {flops / 1e9:.0f} GFLOP/s",
            product,
            f"{100 * work / best / flops:.1f} % used by a dense path per seed",
        ),
        ("machine", f"memory, {2 * 4 * 2**25 / moved / 1e9:.1f} GB/s", moved, ""),
        ("machine", f"uniform numbers, {1e9 * drawn / numbers:.2f} ns each", drawn, share_drawn),
    ]


def table(quick: bool) -> str:
    """The whole table as Markdown."""
    rows: list[Row] = []
    for name, shape in SHAPES.items():
        if quick and name == "(100, 5, 100)":
            continue
        rows += gradient_rows(f"dense {name}", problem_of(*shape))
    rows += gradient_rows("directional (20, 1, 60)", problem_of(20, 1, 60, "directional"))
    stock = pc.experiments.stock_market("random")
    M = _policy(stock)
    dense_best = next(
        t for case, what, t, _ in rows if case == "dense (20, 1, 60)" and what.endswith("float32, one core")
    )
    printed = next(t for case, what, t, _ in rows if case == "dense (20, 1, 60)" and "(a)" in what)
    for label, p in (("float64", stock), ("float32", in_single_precision(stock))):
        rows += seed_rows("stock (20, 1, 60)", label, p, M.astype(p.dtype), printed)
    for kind in ("dense", "directional"):
        rows += exact_rows(f"{kind} (20, 1, 60)", problem_of(20, 1, 60, kind))
    rows += exact_rows("stock (20, 1, 60)", stock)
    for kind in ("dense", "directional"):
        rows += stable_rows(f"{kind} (20, 1, 60)", problem_of(20, 1, 60, kind))
    rows += stable_rows("stock (20, 1, 60)", stock)
    rows += sweep_rows()
    rows += scaling_rows()
    rows += machine_rows(dense_best)
    lines = ["| case (n = m, H, T) | what | time | times (a), or else |", "|---|---|--:|---|"]
    for case, what, took, note in rows:
        shown = f"{took * 1e6:.0f} µs" if took < 1e-2 else f"{took * 1e3:.0f} ms"
        lines.append(f"| {case} | {what} | {shown} | {note} |")
    return "\n".join(lines)
