"""`pc.solve_many`: every problem, every setting, every key, on all devices of all hosts."""

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from perfcontrol._checks import check_integer, check_key, fail
from perfcontrol._programs import program
from perfcontrol.problem import warn_of_unstable_gain
from perfcontrol.solvers.axes import arranged
from perfcontrol.solvers.base import Solution, SolveError
from perfcontrol.solvers.blocks import Work, lanes_of, run_blocks
from perfcontrol.solvers.result import Result, where
from perfcontrol.solvers.rows import Rows, Shared, pick
from perfcontrol.solvers.run_folder import RunFolder, held
from perfcontrol.solvers.runs import Record
from perfcontrol.solvers.solve import slack, solve


def solve_many(
    problems: Any,
    solver: Any,
    M0: Any = None,
    *,
    keys: Any = None,
    max_steps: int | None = None,
    record: Record | None = None,
    every: int = 1,
    throw: bool = False,
    progress: Callable[[int, int], None] | None = None,
    checkpoint: Any = None,
) -> Solution:
    """`pc.solve` for every problem with every solver and every key, on all devices of all hosts.

    Each run is the one that `pc.solve` makes of the same problem, solver and key, to rounding. Runs are worked on in
    blocks: a few at a time on each device, so that they stay in its cache. Where `jax.distributed` was initialised,
    each process works on its share of the runs and returns the answer of all.

    Args:
        problems: one problem; or a stack of them (a leading axis on every array, as `jax.vmap` over what builds them
            returns it); or a list of problems that differ in numbers alone.
        solver: one solver, or a list of solvers that differ in numbers alone.
        M0: one feasible start for all, or one a run, with the axes of the answer before those of the policy (an axis
            of length 1 shares its starts); None: of each problem the feasible policy nearest to zero.
        keys: JAX random keys: one for all runs, or (seeds,), used by every problem and solver, or with an axis for
            each of the axes of problems and solvers before that one, to have keys of their own.
        max_steps: overrides the solver's own number of steps.
        record: as in `pc.solve`; None: nothing is recorded, and `.history` is None.
        every: record every so many steps.
        throw: raise SolveError unless every result is `success`.
        progress: called on the host with (iterations done, iterations in all), runs times steps, of this process.
        checkpoint: folder in which finished blocks are kept; the same call goes on with the others. Several processes
            may share it.

    Returns:
        A `Solution` whose arrays have the axes (problems, solvers, seeds) in front, those left out that were not given
        as many.

    Raises:
        InputError: arguments that do not fit, before any work.
        SolveError: a run failed and `throw` is True; its `.solution` is what all reached.
    """
    axes, shared, rows = arranged(problems, solver, M0, keys)
    problem, one, key = pick(shared.problems, 0), pick(shared.solvers, 0), None if rows.key is None else rows.key[0]
    one = one.on(problem, key)
    one.check(problem)
    if one.needs_key and key is None:
        check_key(key)
    every = check_integer("every", every, 1)
    for name, function in (("record", record), ("progress", progress)):
        if function is not None and not callable(function):
            raise fail(name, type(function).__name__, "be callable", "Pass a function, or leave it out.")
    total = one.max_steps if max_steps is None else check_integer("max_steps", max_steps, 0)
    _check_starts(shared, rows)
    warn_of_unstable_gain(problem)
    process, processes = jax.process_index(), jax.process_count()
    place = np.array_split(np.arange(len(rows.problem)), processes)[process]
    work = Work(shared, record, every, total, total < one.max_steps, lanes_of(problem, one, len(place)))
    parts = {"problems": shared.problems, "solver": shared.solvers, "start": rows.start, "keys": rows.key}
    parts |= {"record": record, "every": every, "steps": total}
    with nullcontext() if checkpoint is None else held(checkpoint, process if processes > 1 else None) as path:
        folder = None if path is None else RunFolder(path, parts)
        answer = run_blocks(work, rows, place, folder, progress)
        if not work.stopped:
            answer = _rescued(answer, shared, rows.take(place))
    if processes > 1:
        answer = _gathered(answer, len(rows.problem))
    solution = Solution(**jax.device_put(jax.tree.map(lambda leaf: leaf.reshape((*axes, *leaf.shape[1:])), answer)))
    if throw and not np.all(where(solution.result, Result.success)):
        raise SolveError(str(solution), solution)
    return solution


@program
def _feasible(shared: Shared, rows: Rows) -> Any:
    def one(row: Rows) -> Any:
        return pick(shared.problems, row.problem).feasible_set.contains(row.start, slack(row.start))

    return jax.lax.map(one, rows, batch_size=64)


def _check_starts(shared: Shared, rows: Rows) -> None:
    """Raise unless each start lies in the set of its problem."""
    if rows.start is None:
        return
    outside = np.flatnonzero(~_feasible(shared, rows))
    if outside.size:
        raise fail(
            "M0",
            f"{outside.size} of {len(rows.problem)} starts outside, the first that of run {outside[0]}",
            "lie in the feasible set",
            "Project them: jax.vmap(problem.feasible_set.project)(M0), or leave M0 out.",
        )


def _rescued(answer: dict[str, Any], shared: Shared, rows: Rows) -> dict[str, Any]:
    """The answer with what `pc.solve` reaches by another method where this one failed and has one."""
    for place in np.flatnonzero(~where(answer["result"], Result.success)):
        row = rows.take(place)
        problem = pick(shared.problems, row.problem)
        solver = pick(shared.solvers, row.solver).on(problem, row.key)
        if solver.rescue(problem) is None:
            break
        ended = solve(problem, solver, row.start, key=row.key, throw=False)
        found = {"M": ended.M, "result": ended.result, "steps": ended.steps, "stats": ended.stats}
        ours = {name: answer[name] for name in found}
        # What comes from a device cannot be written to.
        ours = jax.tree.map(lambda leaf: leaf if leaf.flags.writeable else leaf.copy(), ours)
        answer |= ours
        for leaf, value in zip(*map(jax.tree.leaves, (ours, found)), strict=True):
            leaf[place] = value
    return answer


def _gathered(answer: dict[str, Any], count: int) -> dict[str, Any]:
    """The rows of all processes, which each hold a share of them in their order."""
    shares = [len(share) for share in np.array_split(np.arange(count), jax.process_count())]

    def gather(leaf: np.ndarray) -> np.ndarray:
        filled = np.resize(leaf, (max(shares), *leaf.shape[1:])) if len(leaf) else np.zeros((1, *leaf.shape[1:]))
        parts = multihost_utils.process_allgather(filled)
        return np.concatenate([part[:share] for part, share in zip(np.asarray(parts), shares, strict=True)])

    return jax.tree.map(gather, answer)
