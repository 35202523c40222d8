"""The optimality bound against dense grids, local search, and closed forms."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import perfcontrol as pc
from perfcontrol.theory.optimality.bound import _shares
from tests.oracles.enumeration import enumerate_cost
from tests.theory.optimality.problems import KINDS, SHAPE, reacting
from tests.tools import assert_refused

SIDES = np.linspace(-1.2, 1.2, 9)


@jax.jit
def _costs(problem, policies):
    return jax.vmap(lambda M: pc.expected_cost(problem, problem.feasible_set.project(M)))(policies)


@functools.cache
def _grid():
    return jnp.asarray(np.stack(np.meshgrid(*[SIDES] * 4), axis=-1).reshape(-1, *SHAPE))


@jax.jit
def _gradient(problem, M):
    return jax.value_and_grad(lambda M: pc.expected_cost(problem, problem.feasible_set.project(M)))(M)


def cheapest(problem) -> float:
    """The lowest cost on a dense grid (projected on the set), and by a quasi-Newton search from its best points."""
    grid = _grid()
    costs = np.asarray(_costs(problem, grid))

    def value(flat):
        cost, slope = _gradient(problem, jnp.asarray(flat.reshape(SHAPE)))
        return float(cost), np.asarray(slope).reshape(-1)

    starts = [np.asarray(grid[i]).reshape(-1) for i in np.argsort(costs)[:3]]
    return min([float(np.min(costs)), *(optimize.minimize(value, x, jac=True, method="BFGS").fun for x in starts)])


@pytest.mark.parametrize(
    ("kind", "feasible"),
    [
        pytest.param(*pair, marks=() if i % 5 == 0 else pytest.mark.slow)  # each scale and each set once
        for i, pair in enumerate(KINDS)
    ],
)
def test_bound_contains_the_best_of_a_grid_and_a_local_search(kind, feasible):
    problem = reacting(kind, feasible, 0)
    bound, best = pc.optimality_bound(problem), cheapest(problem)
    assert bound.applicable and bound.closed and bound.status == "proved"
    assert bound.lower <= best * (1 + 1e-9)
    assert bound.upper <= best * (1 + 1e-6)
    assert bound.gap == pytest.approx((bound.upper - bound.lower) / bound.upper) and bound.gap <= 1e-3
    assert float(pc.expected_cost(problem, bound.M)) == pytest.approx(bound.upper, rel=1e-12)
    assert problem.feasible_set.contains(jnp.asarray(bound.M))


@pytest.mark.parametrize(("kind", "feasible"), [("affine", "ball"), ("two affine", "rows"), ("norm", "box")])
def test_no_policy_of_a_cell_is_cheaper_than_the_bound_of_that_cell(kind, feasible):
    """Cells wide enough for θ⁻ and θ⁺ to differ: a bound that is too high cannot hide behind the best policy known."""
    problem = reacting(kind, feasible, 4)
    (share,) = _shares(problem)
    rng = np.random.default_rng(0)
    policies = np.asarray(jax.vmap(problem.feasible_set.project)(jnp.asarray(rng.normal(size=(400, *SHAPE)))))
    costs = np.asarray(_costs(problem, jnp.asarray(policies)))
    scalars = np.array([share.scalars.at(M.reshape(-1)) for M in policies])
    tight = 0
    for pair in range(12):
        low, high = np.sort(scalars[rng.integers(400, size=2)], axis=0)
        inside = np.all((scalars >= low) & (scalars <= high), axis=1)
        form = share.form(share.scalars.variances(low, high))
        bound = share.scalars.least(share.relax(form), low, high, np.inf).value
        assert bound <= costs[inside].min() * (1 + 1e-9), pair
        tight += bound > 0.5 * costs[inside].min()
    assert tight > 0  # and the bounds say something


@pytest.mark.slow
def test_bound_contains_the_best_of_a_grid_on_three_hundred_problems():
    cells, closed = [], 0
    for number in range(300):
        problem = reacting(*KINDS[number % len(KINDS)], 1000 + number)
        bound, best = pc.optimality_bound(problem, max_cells=1000), cheapest(problem)
        assert bound.lower <= best * (1 + 1e-9), number
        assert bound.upper <= best * (1 + 1e-6), number
        cells.append(bound.cells)
        closed += bound.closed
    print(f"cells: median {np.median(cells):g}, nine tenths {np.quantile(cells, 0.9):g}; closed {closed} of 300")
    assert np.median(cells) <= 200


@pytest.mark.slow
def test_interval_narrows_as_it_is_asked_to_and_stays_nested():
    problem = reacting("squared norm", "unconstrained", 3)
    wide, narrow = pc.optimality_bound(problem, gap=0.1), pc.optimality_bound(problem, gap=1e-4)
    assert wide.lower <= narrow.lower <= narrow.upper <= wide.upper * (1 + 1e-12)
    assert narrow.closed and narrow.cells > wide.cells
    one = pc.optimality_bound(problem, gap=1e-4, max_cells=1)
    assert not one.closed and one.cells == 1 and one.lower <= wide.upper


def test_enumeration_of_every_path_agrees_with_the_upper_end_and_is_never_below_the_lower():
    offset, weight, T, Q, R = 0.2, 0.4, 2, np.eye(2), 0.1 * np.eye(2)
    A, B = np.array([[0.6, 0.3], [-0.2, 0.8]]), np.array([[1.0, 0.2], [0.0, 0.7]])
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(A, B), horizon=T, memory=1, gain=np.zeros((2, 2)), noise=pc.Rademacher([0.5, 0.8]),
        cost=pc.QuadraticCost(Q, R), feasible_set=pc.FrobeniusBall(0.7),
        perturbation=pc.DirectionalPerturbation(np.eye(2)[None], pc.Norm([offset], [weight])),
    )  # fmt: skip
    signs = np.array(list(itertools.product([0.5, -0.5], [0.8, -0.8])))

    def enumerated(M):
        size = offset + weight * np.linalg.norm(M)
        return enumerate_cost(
            *(np.broadcast_to(x, (T, 2, 2)) for x in (A, B)),
            *(np.broadcast_to(x, (T + 1, 2, 2)) for x in (np.zeros((2, 2)), Q, R)),
            np.asarray(M),
            [(signs, np.full(4, 0.25))] * T,
            [(size * np.array([np.eye(2), -np.eye(2)]), np.full(2, 0.5))] * T,
            (np.zeros((1, 2)), np.ones(1)),
        )[0]

    bound = pc.optimality_bound(problem)
    assert enumerated(bound.M) == pytest.approx(bound.upper, rel=1e-11)
    for seed in range(30):
        M = problem.feasible_set.project(jnp.asarray(0.5 * np.random.default_rng(seed).normal(size=SHAPE)))
        assert enumerated(M) >= bound.lower


@pytest.mark.parametrize("perturbation", [None, pc.DirectionalPerturbation(np.eye(2)[None], [0.3])])
def test_without_reaction_one_cell_gives_the_stable_policy_s_cost(perturbation):
    problem = reacting("norm", "rows", 7)
    still = pc.PerformativeProblem(
        system=problem.system, horizon=6, memory=1, gain=problem.gain, noise=problem.noise, cost=problem.cost,
        perturbation=perturbation or pc.NoPerturbation(), feasible_set=problem.feasible_set,
    )  # fmt: skip
    bound = pc.optimality_bound(still, gap=1e-8)
    stable = pc.expected_cost(still, pc.solve(still, pc.StablePoint()).M)
    assert bound.cells == 1 and bound.closed
    assert bound.lower == pytest.approx(float(stable), rel=1e-9) and bound.upper == pytest.approx(
        float(stable), rel=1e-9
    )


def declared(feasible_set, scale, directions=1):
    base = reacting("norm", "unconstrained", 11)
    rng = np.random.default_rng(2)
    law = pc.DirectionalPerturbation(rng.normal(size=(directions, 2, 2)), scale)
    return pc.PerformativeProblem(
        system=base.system, horizon=6, memory=1, gain=base.gain, noise=base.noise, cost=base.cost,
        perturbation=law, feasible_set=feasible_set,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("feasible_set", [pc.Unconstrained(), pc.Box(-0.4, 0.3)])
def test_a_function_declared_convex_gives_the_interval_of_the_same_norm(feasible_set):
    known = pc.optimality_bound(declared(feasible_set, pc.Norm([0.2], [0.6], squared=True)))
    told = pc.optimality_bound(
        declared(feasible_set, pc.Function(lambda M: 0.2 + 0.6 * jnp.sum(M**2)[None], convex=True))
    )
    assert told.closed and told.status == "estimated" and known.status == "proved"
    assert told.upper == pytest.approx(known.upper, rel=1e-9)
    assert max(told.lower, known.lower) <= known.upper * (1 + 1e-12)


def test_a_function_that_is_convex_and_not_smooth_is_bounded_too():
    scale = pc.Function(lambda M: jnp.stack([0.1 + 0.5 * jnp.sum(jnp.abs(M)), 0.2 + jnp.max(jnp.abs(M))]), convex=True)
    problem = declared(pc.Unconstrained(), scale, directions=2)
    bound, best = pc.optimality_bound(problem, gap=0.02, max_cells=400), cheapest(problem)
    assert bound.lower <= best * (1 + 1e-9) and bound.closed


def test_structure_and_time_varying_scales_are_bounded():
    rng = np.random.default_rng(4)
    system = pc.LinearSystem(0.7 * np.eye(4), np.eye(4))
    slopes = np.linspace(0.2, 0.5, 6)[:, None, None, None, None] * rng.normal(size=(1, 4, 4))
    for scale in (
        pc.Norm(0.1 * np.ones((6, 1)), np.linspace(0.1, 0.4, 6)[:, None]),
        pc.Affine(np.full((6, 1), 0.2), slopes),
    ):
        problem = pc.PerformativeProblem(
            system=system, horizon=6, memory=1, gain=np.zeros((4, 4)), noise=pc.Uniform(-np.ones(4), np.ones(4)),
            cost=pc.QuadraticCost(np.eye(4), 0.1 * np.eye(4)), structure=pc.RepeatedBlock(2),
            perturbation=pc.DirectionalPerturbation(np.eye(4)[None], scale), feasible_set=pc.Unconstrained(),
        )  # fmt: skip
        bound, best = pc.optimality_bound(problem), cheapest(problem)
        assert bound.closed and bound.lower <= best * (1 + 1e-9) and bound.upper <= best * (1 + 1e-6)


def test_what_the_proof_needs_is_named_where_it_is_missing():
    base = reacting("norm", "ball", 0)

    def refused(*words, **changes):
        parts = {
            "system": base.system, "horizon": 6, "memory": 1, "gain": base.gain, "noise": base.noise,
            "cost": base.cost, "perturbation": base.perturbation, "feasible_set": base.feasible_set,
        } | changes  # fmt: skip
        bound = pc.optimality_bound(pc.PerformativeProblem(**parts))
        assert not bound.applicable and bound.lower is None and bound.M is None
        for word in words:
            assert word in str(bound)

    law = base.perturbation
    refused(
        "general function",
        "convex=True",
        perturbation=pc.DirectionalPerturbation(law.directions, lambda M: 1 + M[0, 0]),
    )
    reacts = pc.Affine(np.zeros((2, 2)), 0.1 * np.ones((2, 2, *SHAPE)))
    refused("mean of the perturbations", perturbation=pc.DirectionalPerturbation(law.directions, law.scale, reacts))
    refused("not of fixed directions", perturbation=pc.DensePerturbation(0.1))
    refused("infinite", horizon=float("inf"))
    refused("quadratic", cost=pc.ConvexCost(pc.Huber(1.0)))
    slopes = np.random.default_rng(0).normal(size=(4, *SHAPE))
    many = pc.DirectionalPerturbation(np.random.default_rng(1).normal(size=(4, 2, 2)), pc.Affine(np.ones(4), slopes))
    refused("4 linear functions", perturbation=many)


def test_gap_and_cells_must_make_sense():
    problem = reacting("norm", "ball", 0)
    for gap in (0.0, -1e-3, 1e-14, float("nan"), float("inf"), "small"):
        assert_refused(lambda gap=gap: pc.optimality_bound(problem, gap=gap), "gap", "1e-09")
    assert_refused(lambda: pc.optimality_bound(problem, max_cells=0), "max_cells", "1")


STOCKS = 3


def small_market(seed: int, feasible: str = "rows", alike: bool = True) -> pc.PerformativeProblem:
    """Three stocks over four days, each seen by itself."""
    rng = np.random.default_rng(seed)
    exposure, eye = 0.4, np.eye(2 * STOCKS)
    shown = np.diag(np.r_[np.ones(STOCKS), np.zeros(STOCKS)])
    covariance = rng.uniform(0.02, 0.2, 4)[:, None, None] * np.eye(STOCKS)
    bought = np.full(STOCKS, 3.0) if alike else np.array([1.0, 3.0, 9.0])
    return pc.PerformativeProblem(
        system=pc.LinearSystem(rng.uniform(0.8, 1.1) * eye, eye), horizon=4, memory=1, gain=np.zeros_like(eye),
        noise=pc.Uniform(-np.ones(2 * STOCKS), np.ones(2 * STOCKS)), cost=pc.QuadraticCost(shown, shown),
        perturbation=pc.StockPerturbation(pc.LogNormal(np.zeros(STOCKS), covariance), exposure),
        feasible_set=pc.RowSum(exposure) if feasible == "rows" else pc.RowSimplex(exposure),
        initial_state=np.r_[np.zeros(STOCKS), bought], structure=pc.RepeatedBlock(2),
    )  # fmt: skip


@pytest.mark.parametrize(("feasible", "alike"), [("rows", True), ("rows", False), ("simplex", True)])
def test_stocks_are_bounded_row_by_row(feasible, alike):
    problem = small_market(1, feasible, alike)
    bound = pc.optimality_bound(problem)
    assert bound.closed and bound.status == "proved"
    # The parts of the rows add up to the cost that the whole problem has.
    assert float(pc.expected_cost(problem, bound.M)) == pytest.approx(bound.upper, rel=1e-11)
    rng = np.random.default_rng(0)
    near = np.asarray(bound.M) + rng.choice([1e-3, 0.03, 0.3], (2000, 1, 1, 1)) * rng.normal(size=(2000, 1, 3, 3))
    costs = _costs(problem, jnp.asarray(near))
    assert bound.lower <= float(costs.min()) and bound.upper <= float(costs.min()) * (1 + 1e-9)


def test_stocks_that_are_alike_share_their_bound_with_stocks_taken_apart(monkeypatch):
    together = pc.optimality_bound(small_market(2))
    monkeypatch.setattr("perfcontrol.theory.optimality.stock_rows._alike", lambda problem: False)
    apart = pc.optimality_bound(small_market(2))
    assert together.cells < apart.cells
    assert [together.upper, together.lower] == pytest.approx([apart.upper, apart.lower], rel=1e-3)


def test_what_stocks_need_is_named_where_it_is_missing():
    problem = small_market(3)

    def changed(**parts):
        names = ("system", "horizon", "memory", "gain", "noise", "cost", "perturbation", "feasible_set", "structure")
        return pc.PerformativeProblem(**{name: getattr(problem, name) for name in names} | parts)

    free = changed(feasible_set=pc.Unconstrained())
    assert "the feasible set" in str(pc.optimality_bound(free))
    paid = changed(cost=pc.QuadraticCost(np.ones((6, 6)), np.eye(6)))
    assert "couple the stocks" in str(pc.optimality_bound(paid))
    correlated = pc.LogNormal(np.zeros(STOCKS), 0.02 * (np.eye(STOCKS) + 1))
    related = changed(perturbation=pc.StockPerturbation(correlated, 0.4))
    assert "independently" in str(pc.optimality_bound(related))
