"""How time is taken: medians of repeated calls of compiled programs, compilation apart."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from perfcontrol._programs import compiler_options

Row = tuple[str, str, float, str]  # case, what, seconds, note


def median_time(call: Callable[[], Any], least: float = 0.3, most: int = 200) -> float:
    """Median seconds of a call, over at least five calls and about `least` seconds."""
    times: list[float] = []
    while len(times) < 5 or (sum(times) < least and len(times) < most):
        times.append(_seconds(call))
    return float(np.median(times))


def _seconds(call: Callable[[], Any]) -> float:
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def side_by_side(calls: list[Callable[[], Any]], rounds: int = 15) -> list[float]:
    """Median seconds of each call, taken in turn, so that a busy moment of the machine meets all of them alike."""
    times = [[_seconds(call) for call in calls] for _ in range(rounds)]
    return [float(median) for median in np.median(times, axis=0)]


def compiled(function: Callable, *arguments: Any) -> tuple[Callable[[], Any], float]:
    """A call of the function on fixed arguments, compiled as the package's programs are; seconds of compilation."""
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    began = time.perf_counter()
    program = jax.jit(lambda leaves: function(*eqx.combine(leaves, static)), compiler_options=compiler_options())
    program = program.lower(dynamic).compile()
    return lambda: program(dynamic), time.perf_counter() - began


def as_markdown(rows: list[Row]) -> str:
    """The rows as a table."""
    lines = ["| case (n = m, H, T) | what | time | times (a), or else |", "|---|---|--:|---|"]
    for case, what, took, note in rows:
        shown = f"{took * 1e6:.0f} µs" if took < 1e-2 else f"{took * 1e3:.0f} ms"
        lines.append(f"| {case} | {what} | {shown} | {note} |")
    return "\n".join(lines)
