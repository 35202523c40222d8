"""`pc.solve`: checks, the run, and what is made of its end."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import check_instance, check_integer, check_key, fail
from perfcontrol._programs import known, on_host, program
from perfcontrol.problem import PerformativeProblem, check_problem, warn_of_unstable_gain
from perfcontrol.response.projected import nearest
from perfcontrol.sets import AbstractSet, Unconstrained
from perfcontrol.solvers.base import AbstractSolver, Solution, SolveError
from perfcontrol.solvers.checkpoint import Forgotten, kept
from perfcontrol.solvers.result import Result, ended
from perfcontrol.solvers.runs import Record, Run, described, from_host, identity, in_chunks, traced


def solve(
    problem: PerformativeProblem,
    solver: AbstractSolver,
    M0: Any = None,
    *,
    key: Any = None,
    max_steps: int | None = None,
    record: Record | None = None,
    every: int = 1,
    throw: bool = True,
    progress: Callable[[int, int], None] | None = None,
    checkpoint: Any = None,
) -> Solution:
    """Run a solver on a problem.

    Iteration n draws its randomness from `fold_in(key, n)`, so the same key gives the same run, whatever the chunks.
    Works under jit and vmap (over keys, starts or stacked problems); then nothing is raised.

    Args:
        problem: the problem.
        solver: `RSGD`, `RRM`, `StablePoint`, ...
        M0: feasible start, free parameters; None: the feasible policy nearest to zero.
        key: JAX random key; required by solvers that sample, and by all where best responses cannot be had exactly.
        max_steps: overrides the solver's own number of steps.
        record: M -> any pytree of arrays, run inside the compiled loop and kept as `history`; default M itself.
        every: record every so many steps.
        throw: raise SolveError unless the result is `success`.
        progress: called on the host with (steps done, steps at most) after each compiled chunk.
        checkpoint: folder in which the run is kept: killed at any moment, the same call goes on from what was saved
            last, to the same bits, and once it has ended returns at once. The history is streamed there and comes back
            memory-mapped. A folder of another run, or one that another process works in, is refused.

    Raises:
        InputError: arguments that do not fit, before any work.
        SolveError: the run failed and `throw` is True; its `.solution` is what was reached.
    """
    check_problem(problem)
    solver = check_instance("solver", solver, AbstractSolver, "pc.StablePoint()").on(problem, key)
    solver.check(problem)
    key = check_key(key) if solver.needs_key or key is not None else None
    every = check_integer("every", every, 1)
    for name, function in (("record", record), ("progress", progress)):
        if function is not None and not callable(function):
            raise fail(name, type(function).__name__, "be callable", "Pass a function, or leave it out.")
    total = solver.max_steps if max_steps is None else check_integer("max_steps", max_steps, 0)
    M0 = _nearest_to_zero(problem) if M0 is None else problem.check_policy("M0", M0)
    concrete = known(problem, solver, M0, key)
    if concrete:
        check_feasible("M0", problem, M0)
    warn_of_unstable_gain(problem)
    start = M0 if concrete else jnp.asarray(M0)
    run = Run(problem, solver, start, key, total, identity if record is None else record, every, progress)
    stopped = max_steps is not None and max_steps < solver.max_steps
    if not concrete and checkpoint is not None:
        raise fail("checkpoint", str(checkpoint), "be left out under jit and vmap", "Call pc.solve itself.")
    if not concrete:
        state, history = traced(run)
        result, stats = solver.finish(problem, state, stopped)
        return Solution(state.M, result, state.steps, history, stats)
    with np.errstate(all="ignore"):  # numbers that are not finite become a named result
        if checkpoint is None:
            solution = _finished(run, stopped, Forgotten())
        else:
            with kept(checkpoint, *described(run)) as keeping:
                solution = keeping.solution()
                if solution is None:
                    solution = _finished(run, stopped, keeping)
    if throw and not ended(solution.result, Result.success):
        raise SolveError(f"{Result[solution.result]} (step {int(solution.steps)})", solution)
    return solution


def check_feasible(name: str, problem: PerformativeProblem, M: Any) -> None:
    """Raise unless a known policy lies in the feasible set."""
    if not isinstance(problem.feasible_set, Unconstrained) and not _contains(problem.feasible_set, M, slack(M)):
        raise fail(
            name,
            f"a policy {float(jnp.linalg.norm(M - problem.feasible_set.project(M))):.3g} away",
            "lie in the feasible set",
            f"Pass problem.feasible_set.project({name}), or leave {name} out.",
        )


def _nearest_to_zero(problem: PerformativeProblem) -> Any:
    """`problem.initial_policy()`, on the host where the problem is known."""
    if not known(problem):
        return problem.initial_policy()
    return nearest(problem.feasible_set, np.zeros(problem.policy_shape, problem.dtype))


@program
def _contains(feasible_set: AbstractSet, M: Any, tolerance: float) -> Array:
    return feasible_set.contains(M, tolerance)


def _finished(run: Run, stopped: bool, keeping: Forgotten) -> Solution:
    """The solution of a run whose numbers are known, by another method where this one fails and has one."""
    solution = _ended(run, stopped, keeping)
    rescuer = None if stopped or ended(solution.result, Result.success) else run.solver.rescue(run.problem)
    if rescuer is not None:
        other = Run(run.problem, rescuer, run.M0, run.key, rescuer.max_steps)
        solution = _rescued(solution, _ended(other, False, keeping.below("rescue", *described(other))))
    keeping.end(solution)
    return solution


def _ended(run: Run, stopped: bool, keeping: Forgotten) -> Solution:
    """The solution of one method."""
    state = from_host(run, keeping) if run.solver.from_host else on_host(in_chunks(run, keeping))
    result, stats = run.solver.finish(run.problem, state, stopped)
    M, steps, stats = _as_jax((state.M, state.steps, stats))
    return Solution(M, result, steps, keeping.history.all(), stats)


@program(on_device=True)
def _as_jax(tree: Any) -> Any:
    """NumPy's arrays as JAX's: one program takes less time than an array at a time."""
    return tree


def _rescued(failed: Solution, rescue: Solution) -> Solution:
    """What the rescuer reached where it succeeded, with the history of the failed run; else the failure."""
    if rescue.result != Result.success:
        return failed
    stats = {name: rescue.stats.get(name, value) for name, value in failed.stats.items()}
    stats["rescued"] = jnp.asarray(True)
    return Solution(rescue.M, rescue.result, failed.steps + rescue.steps, failed.history, stats)


def slack(M: Any) -> float:
    """How far outside of the set rounding may put a policy."""
    return 1e-8 if M.dtype == jnp.float64 else 1e-4
