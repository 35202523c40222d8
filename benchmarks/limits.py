"""How time grows with the size of a problem, and what the machine could do at best."""

import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc
from benchmarks.gradients import batch_gradients
from benchmarks.measure import Row, compiled, median_time
from benchmarks.problems import policy_of, problem_of
from perfcontrol.evaluate.exact import exact_cost


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
            keys = jax.random.split(pc.fast_key(0), seeds)
            times.append(median_time(compiled(batch_gradients, problem, policy_of(problem), keys)[0]))
        value = exponent([case[position[axis]] for case in grid], times)
        rows.append((f"exponent in {axis}", "sampled gradient, directional, float64", times[-1], f"{value:.2f}"))
    times, horizons = [], [60, 240, 960]
    for T in horizons:
        problem = problem_of(20, 1, T, "directional")
        times.append(median_time(compiled(exact_cost, problem, policy_of(problem), policy_of(problem))[0]))
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
    drawn = median_time(compiled(lambda key: jax.random.uniform(key, (numbers,), jnp.float32), pc.fast_key(0))[0])
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
