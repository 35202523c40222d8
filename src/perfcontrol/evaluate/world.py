"""The world that a deployed policy makes, in one program."""

from typing import Any

from perfcontrol._programs import program
from perfcontrol.evaluate.cost_to_go import World, cost_to_go
from perfcontrol.evaluate.impulses import with_impulses
from perfcontrol.evaluate.stationary import stationary_world
from perfcontrol.problem import PerformativeProblem


@program(on_device=True)  # what works with it are programs, too
def world_of(problem: PerformativeProblem, deployed: Any) -> World:
    """The world under the deployed policy's free parameters: `cost_to_go` or its stationary limit, with impulses."""
    make = cost_to_go if problem.is_finite else stationary_world
    return with_impulses(make(problem, problem.structure.lift(deployed)), problem.memory)
