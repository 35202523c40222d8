"""Error bounds against measured runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.oracles.performative_prediction import squared_errors
from tests.theory.problems import small_reaction


def test_error_bounds_lie_above_measured_runs():
    problem = small_reaction()
    M = pc.solve(problem, pc.StablePoint()).M
    radius = float(problem.feasible_set.limit)
    start = jnp.full((1, 1, 1), radius)
    gap = float(jnp.linalg.norm(start - M))
    rrm = pc.solve(problem, pc.RRM(), start, max_steps=6, throw=False)
    for kind in ("rigorous", "global"):
        bound = pc.rrm_error_bound(problem, gap, 6, kind=kind)
        errors = np.linalg.norm(np.asarray(rrm.history - M).reshape(7, -1), axis=1)
        assert np.all(errors <= bound + 1e-12)
    step = pc.InverseStep(*pc.theorem_step_size(problem))
    keys = jax.random.split(jax.random.key(0), 64)

    def run(key):
        record = pc.solve(problem, pc.RSGD(400, step), start, key=key, record=lambda N: jnp.sum((N - M) ** 2))
        return record.history

    errors = np.asarray(jax.vmap(run)(keys)).mean(axis=0)
    recursion = pc.rsgd_error_bound(problem, step, gap**2, 400)
    closed = pc.rsgd_error_bound(problem, step, gap**2, 400, form="closed")
    assert np.all(errors <= recursion * 1.000001) and np.all(recursion <= closed * (1 + 1e-9))


def test_closed_form_bound_refuses_steps_outside_its_conditions():
    problem = small_reaction()
    with pytest.raises(pc.InputError, match="theorem_step_size"):
        pc.rsgd_error_bound(problem, 1e3, 1.0, 10, form="closed")
    with pytest.raises(pc.InputError, match="initial_error"):
        pc.rsgd_error_bound(problem, 1e-3, -1.0, 10)
    with pytest.raises(pc.InputError, match="kind"):
        pc.rrm_error_bound(problem, 1.0, 3, kind="sharp")


def test_recursion_holds_for_performative_prediction_with_its_own_constants():
    """m = 1-ε, L = 1+ε ≥ |1-ε|, V = σ²: the recursion of the docs is above the exact error."""
    epsilon, sigma = 0.5, 0.3
    steps = [0.3 / (1 + 0.01 * n) for n in range(200)]
    exact = squared_errors(steps, 4.0, 10.0, epsilon, sigma)
    bound = [exact[0]]
    for eta in steps:
        bound.append((1 - 2 * eta * (1 - epsilon) + eta**2 * (1 + epsilon) ** 2) * bound[-1] + eta**2 * sigma**2)
    assert np.all(exact <= np.array(bound) * (1 + 1e-12))
