"""The safe step against runs of descent."""

import jax
import jax.numpy as jnp
import pytest

import perfcontrol as pc
from perfcontrol.theory.stability.safe_step import mean_square_stability, safe_step
from tests.theory.problems import prediction_problem, random_problem

pytestmark = pytest.mark.float32


def test_safe_step_keeps_descent_stable_and_four_thresholds_do_not():
    problem = random_problem(3, bounded=False, strength=0.05)
    step = safe_step(problem)
    stability = mean_square_stability(problem)
    assert step == pytest.approx((stability.threshold_estimate - 2 * stability.standard_error) / 4)
    assert safe_step(problem, batch=8) > step
    M = pc.solve(problem, pc.StablePoint()).M
    good = pc.solve(problem, pc.RSGD(2000, step), key=jax.random.key(1))
    assert float(jnp.sum((good.M - M) ** 2)) < 20 * stability.error_floor(step)
    bad = pc.solve(problem, pc.RSGD(2000, stability.mean_threshold * 4), key=jax.random.key(1), throw=False)
    assert bad.result == pc.Result.diverged


def test_safe_step_refuses_an_unstable_mean_field_and_bad_safety():
    with pytest.raises(pc.InputError, match="StablePoint"):
        safe_step(prediction_problem(1.5))
    with pytest.raises(pc.InputError, match="safety"):
        safe_step(prediction_problem(0.5), safety=2.0)
    with pytest.raises(pc.InputError, match="threshold"):
        mean_square_stability(prediction_problem(0.5), samples=64).error_floor(100.0)
