"""Exact evaluation, stable points, and problems swept over a parameter."""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import perfcontrol as pc
from benchmarks.measure import Row, compiled, median_time
from benchmarks.problems import policy_of, problem_of
from perfcontrol.evaluate.cost_to_go import cost_to_go
from perfcontrol.evaluate.exact import cost_and_gradient
from perfcontrol.evaluate.moments import cost_by_moments


def exact_rows(name: str, problem: pc.PerformativeProblem) -> list[Row]:
    """Exact cost and gradient by the cost-to-go form against reverse mode through the moment recursion."""
    M = policy_of(problem)

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
