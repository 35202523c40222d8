"""Every pair of solver, feasible set, perturbation family, structure and cost meets in at least one run.

A greedy covering array of rows, the first few of which meet every value once and run by default. Each run must end in
`success`; whatever claims to be a stable policy must be one by its residual, and the one that StablePoint finds.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.evaluate.cost_to_go import cost_to_go
from perfcontrol.response.quadratic import quadratic
from tests.tools import assert_close, normal

T, H, N = 6, 2, 2  # horizon, memory, states and inputs: one shape for all


def smooth(t, x, u):
    return jnp.sum(jnp.logaddexp(x, -x)) + jnp.sum(jnp.sqrt(1 + u**2)) + 0.1 * (x @ x + u @ u)


def small(M):
    """A number near 0.5 that moves with the policy."""
    return 0.5 + 0.1 * jnp.tanh(jnp.sum(M))


VALUES = 0.3 * normal(1, 3, N, 2 * N)

SOLVERS = {
    "stable": lambda step: pc.StablePoint(),
    "rrm": lambda step: pc.RRM(),
    "anderson": lambda step: pc.RRM(anderson=3),
    "inexact": lambda step: pc.RRM(inner_steps=50),
    "mean field": lambda step: pc.RSGD(1500, step, gradient=pc.Exact()),
    "rsgd": lambda step: pc.RSGD(30, 0.005, batch=2),
    "sampled": lambda step: pc.StablePoint(0.5, sampling=pc.SampleAverage(128, 4096)),
    "lazy": lambda step: pc.RSGD(30, pc.InverseStep(0.5, 100), gradient=pc.TwoPoint(0.1), schedule=pc.Lazy(5)),
    "averaged": lambda step: pc.RSGD(
        100, pc.PowerStep(0.005), batch=4, gradient=pc.EstimatedDynamics(), average=pc.Average(burn_in=0.1)
    ),
}
SETS = {
    "unconstrained": lambda free: pc.Unconstrained(),
    "frobenius": lambda free: pc.FrobeniusBall(0.4),
    "spectral": lambda free: pc.SpectralBall(0.3),
    "rows": lambda free: pc.RowSum(0.2),
    "simplex": lambda free: pc.RowSimplex(0.2),
    "box": lambda free: pc.Box(-0.1, 0.15 * np.ones(free)),
    "support": lambda free: pc.Support(np.eye(free[1], free[2], dtype=bool)),
    "intersection": lambda free: pc.Intersection([pc.RowSum(0.1), pc.Box(-0.3, 0.3)]),
}
FAMILIES = {
    "none": lambda: pc.NoPerturbation(),
    "directional": lambda: pc.DirectionalPerturbation(VALUES[:2, :, :N], lambda M: small(M) * jnp.ones(2)),
    "directional on input": lambda: pc.DirectionalPerturbation(
        VALUES[:1], lambda M: small(M)[None], mean=0.1 * VALUES[2], law="uniform"
    ),
    "finite": lambda: pc.FinitePerturbation(VALUES, lambda M: jnp.stack([small(M), 0.8 - small(M), jnp.asarray(0.2)])),
    "dense": lambda: pc.DensePerturbation(lambda M: 0.3 * small(M), law="sphere"),
    "sampled": lambda: pc.SampledPerturbation(
        lambda key, M: 0.2 * small(M) * jax.random.uniform(key, (T, N, N), M.dtype, -1.0, 1.0)
    ),
}
STRUCTURES = {"full": lambda: pc.FullStructure(), "repeated": lambda: pc.RepeatedBlock(2)}
COSTS = {
    "quadratic": lambda: pc.QuadraticCost(np.eye(N), 0.5 * np.eye(N)),
    "tracking": lambda: pc.QuadraticCost(
        np.eye(N),
        0.5 * np.eye(N),
        cross=0.2 * np.ones((N, N)),
        state_target=[1.0, -1.0],
        input_target=np.ones((T + 1, N)),
    ),
    "convex": lambda: pc.ConvexCost(smooth, strong_convexity=0.2),
}
FACTORS = (SOLVERS, SETS, FAMILIES, STRUCTURES, COSTS)
EXACT = ("stable", "rrm", "anderson", "inexact", "mean field")


def fits(row: tuple) -> bool:
    """Exact solvers need moments and a quadratic cost; where these are, nothing is sampled."""
    solver, _, family, _, cost = row
    exact = family != "sampled" and cost != "convex"
    return not exact if solver == "sampled" else exact or solver not in EXACT


def pairs(row: tuple) -> set:
    return set(itertools.combinations(enumerate(row), 2))


def covering() -> list[tuple]:
    """Greedy: at each turn the valid row with the most pairs not yet met; early turns also count values not yet met."""
    rows = [row for row in itertools.product(*FACTORS) if fits(row)]
    missing, unseen = set().union(*map(pairs, rows)), {item for row in rows for item in enumerate(row)}
    chosen = []
    while missing:
        best = max(rows, key=lambda row: (len(unseen & set(enumerate(row))), len(missing & pairs(row))))
        chosen.append(best)
        missing -= pairs(best)
        unseen -= set(enumerate(best))
    return chosen


ROWS = covering()
QUICK = 9  # rows that run by default: as many as there are solvers


def problem(row: tuple) -> pc.PerformativeProblem:
    _, feasible_set, family, structure, cost = row
    structure = STRUCTURES[structure]()
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.3 * normal(2, N, N), np.eye(N) + 0.3 * normal(3, N, N)),
        horizon=T,
        memory=H,
        noise=pc.Rademacher([1.0, 0.5], mean=[0.2, 0.0]),
        cost=COSTS[cost](),
        perturbation=FAMILIES[family](),
        feasible_set=SETS[feasible_set](structure.free_shape((H, N, N))),
        initial_state=[1.0, -1.0],
        structure=structure,
    )


def test_rows_cover_every_valid_pair_with_at_most_eighty():
    valid = [row for row in itertools.product(*FACTORS) if fits(row)]
    assert set().union(*map(pairs, ROWS)) == set().union(*map(pairs, valid))
    assert len(ROWS) <= 80
    for index, factor in enumerate(FACTORS):
        assert {row[index] for row in ROWS[:QUICK]} == set(factor), "the quick rows leave a value out"


@pytest.mark.parametrize(
    "row",
    [pytest.param(row, marks=[pytest.mark.slow] if i >= QUICK else []) for i, row in enumerate(ROWS)],
    ids=["-".join(row).replace(" ", "_") for row in ROWS],
)
def test_run_ends_well_and_stable_policies_agree(row):
    built, solver = problem(row), row[0]
    step = 0.5 * _inverse_curvature(built) if solver == "mean field" else None
    solution = pc.solve(built, SOLVERS[solver](step), key=jax.random.key(1), record=jnp.linalg.norm)
    assert solution.result == pc.Result.success
    assert solution.M.shape == built.policy_shape and bool(jnp.all(jnp.isfinite(solution.M)))
    assert bool(built.feasible_set.contains(solution.M, 1e-8))
    if solver in EXACT:
        assert float(pc.residual(built, solution.M)) <= 1e-8
    if solver in EXACT and solver != "stable":
        assert_close(solution.M, pc.solve(built, pc.StablePoint(), record=jnp.linalg.norm).M, 1e-6)


def _inverse_curvature(built: pc.PerformativeProblem) -> jax.Array:
    """1/‖Hessian‖ of the cost against the world of the start."""
    M = built.initial_policy()
    return quadratic(built, cost_to_go(built, built.structure.lift(M))).step
