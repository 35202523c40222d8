"""A user's first session in fresh processes: what each first call takes, the same call again, and what it compiles.

Three processes do the same list: one with an empty cache, one with the cache that the first has left, one that dumps
what it compiles, to count programs and instructions.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

INSTRUCTION = re.compile(r"^\s+(ROOT )?[%\w.-]+ = ", re.MULTILINE)


def session(dump: Path | None) -> list[dict[str, Any]]:
    """The list of first calls, in this process."""
    began = time.perf_counter()
    import jax
    import jax.numpy as jnp

    jax_took = time.perf_counter() - began
    began = time.perf_counter()
    import perfcontrol as pc

    rows: list[dict[str, Any]] = [
        {"what": "import jax", "first": jax_took},
        {"what": "import perfcontrol, beyond JAX", "first": time.perf_counter() - began},
    ]
    jax.config.update("jax_enable_x64", True)

    def compiled() -> list[str]:
        return sorted(str(file) for file in dump.glob("*before_optimizations.txt")) if dump else []

    def call(what: str, function: Callable[[], Any]) -> Any:
        before, times = set(compiled()), []
        for _ in range(2):
            began = time.perf_counter()
            value = function()
            jax.block_until_ready(jax.tree.leaves(value))
            times.append(time.perf_counter() - began)
        texts = [Path(name).read_text() for name in compiled() if name not in before]
        instructions = sum(len(INSTRUCTION.findall(text)) for text in texts)
        rows.append(
            {"what": what, "first": times[0], "again": times[1], "programs": len(texts), "instructions": instructions}
        )
        return value

    def problem(reaction: Any, feasible_set: Any) -> Any:
        system = pc.LinearSystem(
            [[0.9, 0.2, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]], [[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]
        )
        return pc.PerformativeProblem(
            system=system,
            horizon=50,
            memory=2,
            gain=pc.design_gain(system, Q=jnp.eye(3), R=jnp.eye(2)),
            noise=pc.Uniform(-jnp.ones(3), jnp.ones(3)),
            cost=pc.QuadraticCost(Q=jnp.eye(3), R=0.1 * jnp.eye(2)),
            perturbation=pc.DirectionalPerturbation([jnp.eye(3)], reaction),
            feasible_set=feasible_set,
        )

    reaction = pc.Function(lambda M: 0.1 + 0.2 * jnp.sum(M**2)[None])
    free = call("problem", lambda: problem(reaction, None))
    stable = call("StablePoint", lambda: pc.solve(free, pc.StablePoint()))
    call("expected cost", lambda: pc.expected_cost(free, stable.M))
    call("residual", lambda: pc.residual(free, stable.M))
    call("best response", lambda: pc.best_response(free, stable.M))
    call("gradient", lambda: pc.expected_gradient(free, stable.M))
    steps = pc.InverseStep(2.0, 1000.0)
    call("RSGD, 2000 steps", lambda: pc.solve(free, pc.RSGD(2000, steps), key=jax.random.key(0)))
    ball = problem(pc.Norm([0.1], [0.2], squared=True), pc.FrobeniusBall(1.0))
    call("RRM on a ball", lambda: pc.solve(ball, pc.RRM()))
    call("Continuation on a ball", lambda: pc.solve(ball, pc.Continuation()))
    for kind in ("sharp", "global", "rigorous", "paper"):
        call(f"certificate, {kind}", lambda kind=kind: pc.certify(free if kind == "sharp" else ball, kind).holds)
    call("safe step", lambda: pc.safe_step(free, key=jax.random.key(0)))
    return rows


def in_a_fresh_process(cache: Path | None = None, dump: Path | None = None) -> list[dict[str, Any]]:
    """`session` in another process, with a cache of compiled programs or with a dump of what is compiled."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))}
    environment |= {"JAX_PLATFORMS": "cpu"}
    if cache is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
    if dump is not None:
        environment["XLA_FLAGS"] = f"--xla_dump_to={dump} --xla_dump_hlo_as_text"
    command = [sys.executable, "-m", "benchmarks.first_calls", *([] if dump is None else [str(dump)])]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def table() -> str:
    """The table as Markdown."""
    with tempfile.TemporaryDirectory() as folder:
        cold = in_a_fresh_process(cache=Path(folder) / "cache")
        warm = in_a_fresh_process(cache=Path(folder) / "cache")
        counted = in_a_fresh_process(dump=Path(folder) / "dump")
    lines = [
        "| first call | empty cache | cache on disk | again | programs | instructions |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for row, cached, count in zip(cold, warm, counted, strict=True):
        again = f"{1e3 * row['again']:.1f} ms" if "again" in row else ""
        sizes = f"{count['programs']} | {count['instructions']}" if "programs" in row else "|"
        lines.append(f"| {row['what']} | {row['first']:.2f} s | {cached['first']:.2f} s | {again} | {sizes} |")
    total = [sum(row["first"] for row in rows) for rows in (cold, warm)]
    programs, instructions = (sum(row.get(name, 0) for row in counted) for name in ("programs", "instructions"))
    lines.append(f"| all | {total[0]:.1f} s | {total[1]:.1f} s | | {programs} | {instructions} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(json.dumps(session(Path(sys.argv[1]) if len(sys.argv) > 1 else None)))
