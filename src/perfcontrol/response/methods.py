"""Which method finds a best response, and what it needs to know of the cost: known from types and shapes alone."""

import math
from typing import Any, NamedTuple

from perfcontrol._programs import program
from perfcontrol.evaluate.cost_to_go import World
from perfcontrol.problem import PerformativeProblem
from perfcontrol.response import quadratic as quadratics
from perfcontrol.response.affine import Affine, AffineByProducts
from perfcontrol.response.projected import Projected, ProjectedByFactors
from perfcontrol.response.quadratic import Factors, factors, quadratic, quadratic_by_passes, stationary
from perfcontrol.response.separable import Separable
from perfcontrol.sets import FullStructure, Unconstrained

Method = Affine | AffineByProducts | Projected | ProjectedByFactors | Separable


def is_held(problem: PerformativeProblem) -> bool:
    """Whether the Hessian is held as a matrix."""
    full = isinstance(problem.structure, FullStructure)
    return math.prod(problem.lifted_shape if full else problem.policy_shape) <= quadratics.DENSE_LIMIT


def is_free(problem: PerformativeProblem) -> bool:
    """Whether there is neither constraint nor structure."""
    return isinstance(problem.feasible_set, Unconstrained) and isinstance(problem.structure, FullStructure)


def shape_of_cost(problem: PerformativeProblem, world: World) -> Any:
    """What the methods need to know of the quadratic; finite unless the world overflows."""
    factored = stationary(world) and isinstance(problem.structure, FullStructure)
    if factored and (is_free(problem) or (is_held(problem) and not problem.feasible_set.affine)):
        return factors(problem, world)
    return quadratic(problem, world) if is_held(problem) else quadratic_by_passes(problem, world)


def method_of(problem: PerformativeProblem, world: World, form: Any) -> Method:
    """The cheapest method that is exact for this kind of problem."""
    if isinstance(form, Factors):
        free = _separable(problem, world, form)
        if is_free(problem):
            return free

        def dense() -> Projected:
            return Projected(problem.feasible_set, quadratic(problem, world))

        return ProjectedByFactors(problem.feasible_set, form, free.step, free.regular, dense)
    if problem.feasible_set.affine:
        return (Affine if is_held(problem) else AffineByProducts)(problem.feasible_set, form)
    return Projected(problem.feasible_set, form)


class _ByProducts(NamedTuple):
    """`AffineByProducts` in one program."""

    problem: PerformativeProblem
    world: World

    def solve(self, gradient: Any) -> Any:
        return _solve_by_products(self.problem, self.world, gradient)

    def minimise(self, start: Any) -> tuple[Any, Any]:
        return _minimise_by_products(self.problem, self.world, start)


def _by_products(problem: PerformativeProblem, world: World) -> AffineByProducts:
    return AffineByProducts(problem.feasible_set, quadratic_by_passes(problem, world))


_solve_by_products = program(lambda problem, world, gradient: _by_products(problem, world).solve(gradient))
_minimise_by_products = program(lambda problem, world, start: _by_products(problem, world).minimise(start))


def _separable(problem: PerformativeProblem, world: World, form: Factors) -> Separable:
    def dense() -> Affine | _ByProducts:
        if is_held(problem):
            return Affine(problem.feasible_set, quadratic(problem, world))
        return _ByProducts(problem, world)

    return Separable(form, dense)


def step_length(problem: PerformativeProblem, world: World, form: Any) -> Any:
    """η = 1/‖Hessian‖."""
    return _separable(problem, world, form).step if isinstance(form, Factors) else form.step
