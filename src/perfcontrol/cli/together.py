"""Points of a sweep in blocks that `pc.solve_many` solves together: those that differ in numbers alone.

Blocks depend on the grid and not on what is finished, so that a sweep that was stopped ends with the same bits.
"""

import time
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

from perfcontrol.cli.plans import recorded_every, solved

if TYPE_CHECKING:
    from perfcontrol.files.building import Plan
    from perfcontrol.files.run import Run

TOGETHER = 64  # points in a block
WORTH = 500  # points from which compiling a method whole pays that else works from the host


class Block(NamedTuple):
    """Places in the grid, what is solved there, and to how many points the block is filled up."""

    places: list[int]
    plans: "list[Plan]"
    size: int

    def solved(self) -> list["Run"]:
        """The runs of its points."""
        return [solved(self.plans[0], lambda *_: None)] if self.size == 1 else _solved_together(self.plans, self.size)


def blocks(plans: "Iterable[Plan]", count: int) -> Iterator[Block]:
    """All plans in blocks; one by one where they differ in more than numbers or where compiling would take longer."""
    open_blocks: list[tuple[Any, Block]] = []  # few kinds: compared one by one, since not all of them can be hashed
    for place, plan in enumerate(plans):
        kind = _kind(plan, count)
        if kind is None:
            yield Block([place], [plan], 1)
            continue
        index = next((i for i, (known, _) in enumerate(open_blocks) if known == kind), len(open_blocks))
        if index == len(open_blocks):
            open_blocks.append((kind, Block([], [], 0)))
        block = open_blocks[index][1]
        block.places.append(place)
        block.plans.append(plan)
        if len(block.plans) == TOGETHER:
            yield block._replace(size=TOGETHER)
            open_blocks[index] = kind, Block([], [], TOGETHER)  # the next one uses the same compiled programs
    yield from (block._replace(size=max(block.size, len(block.plans))) for _, block in open_blocks if block.plans)


def _kind(plan: "Plan", count: int) -> Any:
    """What points of a block share; None for a point that stays alone."""
    import jax
    import jax.numpy as jnp

    from perfcontrol._fingerprint import fingerprint
    from perfcontrol.solvers import StablePoint

    solver, key = plan.solver or StablePoint(), jax.random.key(plan.seed)
    if solver.on(plan.problem, key).from_host and count < WORTH:
        return None
    leaves, structure = jax.tree.flatten((plan.problem, plan.M0))
    alike = [jnp.shape(leaf) if isinstance(leaf, jax.Array) else leaf for leaf in leaves]
    return structure, alike, fingerprint(solver), plan.seed


def _solved_together(plans: "list[Plan]", size: int) -> "list[Run]":
    import jax
    import jax.numpy as jnp
    import numpy as np

    from perfcontrol.files.run import Run
    from perfcontrol.solvers import StablePoint, solve_many

    first = plans[0]
    solver = first.solver or StablePoint()
    every = recorded_every(solver)
    filled = plans + plans[-1:] * (size - len(plans))
    began = time.perf_counter()
    found = solve_many(
        [plan.problem for plan in filled],
        solver,
        None if first.M0 is None else jnp.stack([plan.M0 for plan in filled]),
        keys=jax.random.key(first.seed),
        record=lambda M: M,
        every=every,
    )
    seconds = round((time.perf_counter() - began) / len(plans), 3)
    held = jax.tree.map(np.asarray, found)
    ends = [jax.tree.map(lambda leaf, place=place: jnp.asarray(leaf[place]), held) for place in range(len(plans))]
    return [
        Run(plan.problem, end, solver, plan.seed, plan.M0, every, (), seconds=seconds)
        for plan, end in zip(plans, ends, strict=True)
    ]
