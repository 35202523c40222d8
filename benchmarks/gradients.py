"""Sampled gradients: NumPy baselines, ours on one path and on many, and how many paths are best worked on together."""

import jax
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

import perfcontrol as pc
from benchmarks import numpy_gradients
from benchmarks.measure import Row, compiled, median_time, side_by_side
from benchmarks.problems import policy_of
from perfcontrol.evaluate.adjoint import mean_path_gradient, path_gradient
from perfcontrol.evaluate.paths import lanes
from perfcontrol.evaluate.rollout import sample_path
from perfcontrol.experiments.batches import in_single_precision

SEEDS = 288
BY_KERNEL = ", by the kernel"
LANES = (4, 8, 16)


def batch_gradients(
    problem: pc.PerformativeProblem, M: jax.Array, keys: jax.Array, together: int | None = None
) -> jax.Array:
    """A sampled path gradient for every key, on one core, so many paths `together` (the number that ours chooses)."""
    together = together or lanes(problem, along=True)
    return jax.lax.map(lambda key: mean_path_gradient(problem, M, M, key, 1), keys, batch_size=together)


def gradients_on_all_cores(problem: pc.PerformativeProblem, M: jax.Array, keys: jax.Array) -> jax.Array:
    """The same, the keys shared out over the host's cores."""
    mesh = Mesh(np.array(jax.devices()), ("keys",))
    spread = jax.shard_map(
        lambda keys: batch_gradients(problem, M, keys), mesh=mesh, in_specs=P("keys"), out_specs=P("keys"),
        check_vma=False,
    )  # fmt: skip
    return spread(keys)


def path_row(name: str, label: str, problem: pc.PerformativeProblem, M: jax.Array, printed: float) -> Row:
    """Seconds of a step of a sampling method without projection: a path is drawn, simulated, differentiated."""
    call, build = compiled(lambda p, M, key: mean_path_gradient(p, M, M, key, 1), problem, M, pc.fast_key(2))
    took = median_time(call)
    note = f"{printed / took:.0f} (compiled in {build:.1f} s)"
    return (name, f"ours, draw, simulate and gradient, {label}", took, note)


def seed_rows(
    name: str, label: str, problem: pc.PerformativeProblem, M: jax.Array, printed: float, key: jax.Array | None = None
) -> list[Row]:
    """Seconds per seed of `SEEDS`, on one core and on all; `key` is a fast one unless given."""
    rows: list[Row] = []
    keys = jax.random.split(pc.fast_key(3) if key is None else key, SEEDS)
    for function, where in ((batch_gradients, "one core"), (gradients_on_all_cores, f"{len(jax.devices())} cores")):
        call, build = compiled(function, problem, M, keys)
        took = median_time(call) / SEEDS
        note = f"{printed / took:.0f} (compiled in {build:.1f} s)"
        rows.append((name, f"ours, the same per seed of {SEEDS}, {label}, {where}", took, note))
    return rows


def sampled_rows(name: str, problem: pc.PerformativeProblem, printed: float) -> list[Row]:
    """One path and many seeds, both precisions."""
    M = policy_of(problem)
    rows: list[Row] = []
    for label, p in (("float64", problem), ("float32", in_single_precision(problem))):
        rows.append(path_row(name, label, p, M.astype(p.dtype), printed))
        rows += seed_rows(name, label, p, M.astype(p.dtype), printed)
    return rows


def kernel_rows(name: str, problem: pc.PerformativeProblem, printed: float) -> list[Row]:
    """`sampled_rows` by the kernel in C++, which must be switched on: one path in float64, many seeds in float32."""
    M, single = policy_of(problem), in_single_precision(problem)
    one = path_row(name, f"float64{BY_KERNEL}", problem, M, printed)
    return [one, *seed_rows(name, f"float32{BY_KERNEL}", single, M.astype(single.dtype), printed)]


def numpy_baselines(problem: pc.PerformativeProblem, M: jax.Array) -> tuple[float, float]:
    """Seconds of (a) and (b) on one path; both are checked against ours first."""
    path = sample_path(problem, problem.lift(M), problem.lift(M), pc.fast_key(1))
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


def gradient_rows(name: str, problem: pc.PerformativeProblem) -> tuple[list[Row], float]:
    """NumPy against ours on one path given, drawn, and on many; and the seconds of the printed formula."""
    printed, adjoint = numpy_baselines(problem, policy_of(problem))
    rows: list[Row] = [
        (name, "(a) printed formula, NumPy", printed, "1"),
        (name, "(b) adjoint, NumPy", adjoint, f"{printed / adjoint:.1f}"),
    ]
    for label, p in (("float64", problem), ("float32", in_single_precision(problem))):
        policy = policy_of(problem).astype(p.dtype)
        path = sample_path(p, p.lift(policy), p.lift(policy), pc.fast_key(1))
        call, build = compiled(path_gradient, p, path)
        took = median_time(call)
        note = f"{printed / took:.0f} (compiled in {build:.1f} s)"
        rows.append((name, f"ours, gradient of a path, {label}", took, note))
    return rows + sampled_rows(name, problem, printed), printed


def lane_rows(name: str, label: str, problem: pc.PerformativeProblem, M: jax.Array, printed: float) -> list[Row]:
    """Seconds per seed of `SEEDS` on one core, by the number of paths that are worked on together."""
    keys = jax.random.split(pc.fast_key(3), SEEDS)
    calls = [compiled(batch_gradients, problem, M, keys, together)[0] for together in LANES]
    took = np.asarray(side_by_side(calls)) / SEEDS
    chosen = lanes(problem, along=True)
    return [
        (
            name,
            f"{together} paths together, {label}, one core",
            seconds,
            f"{printed / seconds:.0f}" + (" (chosen)" if together == chosen else ""),
        )
        for together, seconds in zip(LANES, took, strict=True)
    ]
