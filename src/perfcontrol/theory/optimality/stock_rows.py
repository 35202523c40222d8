"""The stock market stock by stock: what one row of the portfolio costs depends on that row alone.

Where system, gain and cost keep the stocks apart, only the diagonal of the covariance of V enters: for stocks that grow
independently and alike, Var V_l = Var(e) ‖row l‖² / exposure². So C(M; M) is a sum over rows p, each part convex in p
and increasing in ‖p‖: one scalar a row instead of one for the whole policy.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._linalg import along_time, as_dense
from perfcontrol._programs import program
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.cost_to_go import CostToGo, cost_to_go
from perfcontrol.evaluate.exact import weigh
from perfcontrol.perturbations import StockPerturbation
from perfcontrol.perturbations.stock import StockCovariance
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import AbstractRandomVector
from perfcontrol.sets import RepeatedBlock, RowSimplex, RowSum
from perfcontrol.theory.certificates.quadratic_form import Expansion, GivenMoments, expand
from perfcontrol.theory.facts import nearest_to_zero
from perfcontrol.theory.optimality.distance import Distance
from perfcontrol.theory.optimality.relaxation import OnAffine, OnSet, Relaxation
from perfcontrol.theory.optimality.search import Share

ALIKE = 1e-12  # relative differences that count as rounding


@program
def _world(problem: PerformativeProblem, base: Any, size: Any) -> CostToGo:
    """The world in which every row has ‖p‖² / exposure² = size."""
    law, lifted, T = problem.perturbation, problem.structure.lift(base), problem.horizon
    assert isinstance(law, StockPerturbation)
    spread = size * along_time(law.growth.covariance, 2, T)
    given = GivenMoments(law.mean_operator(lifted, T), StockCovariance(spread), problem.state_size)
    return cost_to_go(eqx.tree_at(lambda p: p.perturbation, problem, given), lifted)


@program
def _row_costs(problem: PerformativeProblem, base: Any, size: Any) -> Array:
    """What each row costs at the policy `base`, (L,): the stage cost of each stock alone."""
    cost, count = problem.cost, problem.state_size // 2
    assert isinstance(cost, QuadraticCost)

    def of_stock(stock: Array) -> Array:
        shown = jnp.tile(jnp.arange(count) == stock, 2)
        only = QuadraticCost(cost.Q * shown, cost.R * shown, discount=cost.discount)
        alone = eqx.tree_at(lambda p: p.cost, problem, only)
        return weigh(alone, _world.function(alone, base, size), base)[0]

    return jax.lax.map(of_stock, jnp.arange(count))


def _together(matrix: Any, count: int) -> bool:
    """Whether a matrix over [r; q] keeps the stocks apart."""
    dense = np.asarray(as_dense(matrix))
    rows, columns = (np.arange(side) % count for side in dense.shape[-2:])
    return not np.any(dense[..., rows[:, None] != columns[None]])


def obstacles_to_rows(problem: PerformativeProblem) -> list[str]:
    """Why the cost is not known to fall into rows."""
    law, cost, missing = problem.perturbation, problem.cost, []
    assert isinstance(law, StockPerturbation)
    covariance = np.asarray(law.growth.covariance, dtype=float)
    count = problem.state_size // 2
    alike = covariance[..., :1, :1] * np.eye(count)
    if np.abs(covariance - alike).max() > ALIKE * np.abs(covariance).max():
        missing.append("the stocks do not grow independently and alike: pass such a growth to pc.StockPerturbation")
    if not (isinstance(problem.structure, RepeatedBlock) and problem.policy_shape == (1, count, count)):
        missing.append("the policy is not one portfolio block: pass memory=1 and structure=pc.RepeatedBlock(2)")
    if not isinstance(problem.feasible_set, RowSum | RowSimplex):
        missing.append("the rows are not apart in the feasible set: pass feasible_set=pc.RowSum(exposure)")
    parts = [problem.system.A, problem.system.B, problem.gain]
    if isinstance(cost, QuadraticCost):
        parts += [cost.Q, cost.R]
        if any(part is not None for part in (cost.cross, cost.state_target, cost.input_target)):
            missing.append("the cost has targets or cross terms: pass cost=pc.QuadraticCost(Q, R)")
    if not all(_together(part, count) for part in parts):
        missing.append("system, gain or cost couple the stocks: pass matrices that are diagonal in them")
    return missing


def _swap(count: int, stock: int) -> np.ndarray:
    """The order of the stocks in which the first and another one change places."""
    order = np.arange(count)
    order[[0, stock]] = [stock, 0]
    return order


def _alike(problem: PerformativeProblem) -> bool:
    """Whether swapping any two stocks leaves the problem as it is: then all rows cost the same, entries swapped."""
    count, noise, start, cost = problem.state_size // 2, problem.noise, problem.initial_state, problem.cost
    assert isinstance(cost, QuadraticCost) and isinstance(noise, AbstractRandomVector)
    matrices = [as_dense(problem.system.A), as_dense(problem.system.B), problem.gain, cost.Q, cost.R]
    matrices += [noise.covariance, start.covariance]

    def same(numbers: Any, axes: int, stock: int) -> bool:
        order = np.concatenate([_swap(count, stock), count + _swap(count, stock)])
        numbers = np.asarray(numbers, dtype=float)
        moved = numbers[..., order] if axes == 1 else numbers[..., order[:, None], order[None]]
        return bool(np.abs(moved - numbers).max() <= ALIKE * np.abs(numbers).max())

    return all(
        all(same(matrix, 2, stock) for matrix in matrices) and same(noise.mean, 1, stock) and same(start.mean, 1, stock)
        for stock in range(1, count)
    )


def row_shares(problem: PerformativeProblem) -> list[Share]:
    """One share a stock; stocks that are alike share one."""
    law = problem.perturbation
    assert isinstance(law, StockPerturbation)
    base = np.asarray(nearest_to_zero(problem), dtype=float)
    count, exposure = base.shape[-1], float(law.exposure)
    together = _alike(problem)
    worlds: dict[float, tuple[Expansion, np.ndarray]] = {}

    def at(size: float) -> tuple[Expansion, np.ndarray]:
        if size not in worlds:  # the searches of like rows ask for the same cells
            form = expand(problem, base, _world(problem, base, np.asarray(size)))
            worlds[size] = form, _row_costs(problem, base, np.asarray(size))
        return worlds[size]

    def share(row: int) -> Share:
        own, shape, feasible = slice(row * count, (row + 1) * count), (1, 1, count), problem.feasible_set
        rows = range(count) if together else [row]
        places = np.stack([k * count + (_swap(count, k) if together else np.arange(count)) for k in rows])
        start = base[0, row]

        def form(variances: np.ndarray) -> Expansion:
            whole, costs = at(float(variances.item()))
            return Expansion(costs[row], whole.gradient[own], whole.hessian[own, own])

        def relax(form: Expansion) -> Relaxation:
            if feasible.affine:
                centre = np.eye(count) - 1 / count
                return OnAffine(start, np.linalg.svd(centre)[0][:, : count - 1], form)
            return OnSet(feasible, shape, start, form)

        def value(p: np.ndarray) -> float:
            cost, gradient, hessian = form(np.asarray(p @ p / exposure**2))
            return float(cost + gradient @ (p - start) + (p - start) @ hessian @ (p - start) / 2)

        zero = jnp.zeros(shape)
        far = feasible.farthest(zero)
        distance = Distance(
            np.zeros(count),
            feasible.distance(zero),
            np.inf if far is None else far,
            [[0.0]],
            [[1 / exposure]],
            1,
            1.0,
            0.0,
        )
        return Share(places, distance, form, relax, value, lambda p: p)

    return [share(row) for row in range(1 if together else count)]
