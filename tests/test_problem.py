"""The checked bundle: shapes, lifting, and every fault refused before any work."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol import _checks
from tests.tools import DOUBLE, assert_close, assert_refused, normal, random_psd

n, m, T = 4, 2, 5


def build(**parts):
    arguments = {
        "system": pc.LinearSystem(0.5 * normal(1, n, n), normal(2, n, m)),
        "horizon": T,
        "noise": pc.Gaussian(np.zeros(n), np.eye(n)),
        "cost": pc.QuadraticCost(np.eye(n), np.eye(m)),
    }
    return pc.PerformativeProblem(**(arguments | parts))


@pytest.mark.float32
def test_problem_knows_its_shapes_and_precision():
    problem = build(memory=3)
    assert problem.policy_shape == problem.lifted_shape == (3, m, n)
    assert problem.gains().shape == (T + 1, m, n)
    assert problem.dtype == jnp.result_type(float)
    assert_close(problem.initial_state.mean, np.zeros(n), 0, 0)


def test_problem_lifts_free_parameters_of_a_structure():
    problem = build(memory=2, structure=pc.RepeatedBlock(2))
    assert problem.policy_shape == (2, 1, 2) and problem.lifted_shape == (2, m, n)
    theta = normal(3, 2, 1, 2)
    assert_close(problem.lift(theta), pc.RepeatedBlock(2).lift(theta), 0, 0)


def test_initial_policy_is_the_feasible_one_nearest_to_zero():
    assert_close(build().initial_policy(), np.zeros((1, m, n)), 0, 0)
    assert_close(build(feasible_set=pc.RowSum(2.0)).initial_policy(), np.full((1, m, n), 0.5))


def test_numbers_stand_for_every_component_of_a_law():
    problem = build(noise=pc.Uniform(-1.0, 1.0), initial_state=3.0)
    assert problem.noise.mean.shape == (n,)
    assert_close(problem.initial_state.mean, np.full(n, 3.0), 0, 0)


def test_sensitivity_is_per_unit_of_the_free_parameters():
    law = pc.DirectionalPerturbation(normal(4, 1, n, n), pc.Affine([1.0], normal(5, 1, 1, m, n)))
    full, repeated = build(perturbation=law), build(perturbation=law, structure=pc.RepeatedBlock(2))
    assert_close(repeated.sensitivity(), np.sqrt(2) * np.asarray(full.sensitivity()))
    assert full.perturbation_bound() is None
    assert build(perturbation=law, feasible_set=pc.FrobeniusBall(1.0)).perturbation_bound().shape == (T,)


def test_problem_is_a_pytree_that_may_be_built_under_jit():
    problem = build(gain=0.1 * normal(6, m, n))
    again = jax.tree.unflatten(*jax.tree.flatten(problem)[::-1])
    assert_close(again.gain, problem.gain, 0, 0)

    @jax.jit
    def cost(growth):
        system = pc.LinearSystem(growth * jnp.eye(n), normal(2, n, m))
        return jnp.sum(build(system=system).initial_policy()) + growth

    assert float(cost(0.5)) == 0.5
    with pytest.raises(AttributeError):
        problem.horizon = 3


def wrong_scale(scale):
    return lambda: build(perturbation=pc.DirectionalPerturbation([np.eye(n)], scale))


PROBLEMS_REFUSED = {
    "horizon zero": (lambda: build(horizon=0), "horizon", "at least 1"),
    "horizon not whole": (lambda: build(horizon=5.0), "horizon", "integer"),
    "memory zero": (lambda: build(memory=0), "memory", "at least 1"),
    "memory not whole": (lambda: build(memory=True), "memory", "integer"),
    "memory of the horizon": (lambda: build(memory=T), "memory", "below the horizon 5"),
    "system length": (
        lambda: build(system=pc.LinearSystem(np.ones((4, n, n)), np.ones((n, m)))),
        "horizon",
        "4 time steps",
    ),
    "system matrix": (lambda: build(system=np.eye(n)), "system", "LinearSystem"),
    "noise array": (lambda: build(noise=np.eye(n)), "noise", "ndarray"),
    "noise size": (lambda: build(noise=pc.Gaussian(np.zeros(3), np.eye(3))), "noise", "dimension 3", "n = 4"),
    "noise length": (lambda: build(noise=pc.Sequence(np.ones((4, n)))), "noise", "4 time steps", "5"),
    "initial size": (lambda: build(initial_state=[1.0, 2.0]), "initial_state", "dimension 2"),
    "initial nan": (lambda: build(initial_state=[1.0, np.nan, 0.0, 0.0]), "value", "nan"),
    "initial sequence": (lambda: build(initial_state=pc.Sequence(np.ones((T, n)))), "initial_state", "one random"),
    "initial linear sequence": (
        lambda: build(initial_state=pc.Linear(pc.Sequence(np.ones((T, n))), np.eye(n))),
        "initial_state",
        "varies in time",
    ),
    "cost": (lambda: build(cost=np.eye(n)), "cost", "QuadraticCost"),
    "Q size": (lambda: build(cost=pc.QuadraticCost(np.eye(3), np.eye(m))), "Q", "(3, 3)", "(4, 4)"),
    "R size": (lambda: build(cost=pc.QuadraticCost(np.eye(n), np.eye(3))), "R", "(3, 3)", "(2, 2)"),
    "Q length": (lambda: build(cost=pc.QuadraticCost(np.ones((T, 1, 1)) * np.eye(n), np.eye(m))), "Q", "(6, 4, 4)"),
    "gain swapped": (lambda: build(gain=np.ones((n, m))), "gain", "swapped", "(2, 4)"),
    "gain length": (lambda: build(gain=np.ones((T, m, n))), "gain", "(5, 2, 4)", "(6, 2, 4)"),
    "gain number": (lambda: build(gain=0.5), "gain", "0.5", "(2, 4)"),
    "gain nan": (lambda: build(gain=np.full((m, n), np.nan)), "gain", "nan"),
    "perturbation": (lambda: build(perturbation=np.eye(n)), "perturbation", "AbstractPerturbation"),
    "scale shape": (wrong_scale(lambda M: M[0, 0]), "scale", "(4,)", "(5, 1)"),
    "scale length": (wrong_scale(np.ones((4, 1))), "scale", "(4, 1)"),
    "feasible set": (lambda: build(feasible_set="ball"), "feasible_set", "AbstractSet"),
    "row totals": (lambda: build(feasible_set=pc.RowSum(np.ones((2, m)))), "total", "(2, 2)", "(1, 2)"),
    "structure": (lambda: build(structure=2), "structure", "RepeatedBlock"),
    "blocks": (lambda: build(structure=pc.RepeatedBlock(4)), "structure", "m, n = 2, 4"),
}


@pytest.mark.parametrize("case", PROBLEMS_REFUSED.values(), ids=PROBLEMS_REFUSED.keys())
def test_problem_is_refused_with_a_four_part_error(case):
    assert_refused(*case)


def test_policy_errors_say_what_to_do():
    problem = build(memory=1)
    assert_refused(lambda: problem.check_policy("M", np.zeros((1, n, m))), "M", "swapped", "(1, 2, 4)")
    assert_refused(lambda: problem.check_policy("M", np.zeros((m, n))), "M", "M[None]")
    structured = build(structure=pc.RepeatedBlock(2))
    assert_refused(lambda: structured.check_policy("M", np.zeros((1, m, n))), "M", "free parameters")
    assert_refused(lambda: problem.check_policy("M", "policy"), "M", "real numbers")


def test_rounding_does_not_make_a_weight_asymmetric_or_indefinite():
    Q = np.asarray(random_psd(7, n))
    almost = Q + 1e-17 * np.asarray(normal(8, n, n))
    build(cost=pc.QuadraticCost(almost, np.zeros((m, m))))


@pytest.mark.float32
def test_tolerance_below_what_the_precision_reaches_is_refused():
    assert _checks.check_tolerance(None, jnp.float64) == 1e-11 and _checks.check_tolerance(None, jnp.float32) == 1e-5
    assert_refused(lambda: _checks.check_tolerance(1e-9, jnp.float32), "tolerance", "float32", "jax_enable_x64")
    assert_refused(lambda: _checks.check_tolerance(1e-17, jnp.float64), "tolerance", "float64")
    assert_refused(lambda: _checks.check_tolerance(-1.0, jnp.float64), "tolerance", "positive")


@pytest.mark.float32
def test_double_precision_data_warns_once_when_jax_is_in_single_precision(monkeypatch, recwarn):
    monkeypatch.setattr(_checks, "_warned_about_precision", False)
    for _ in range(2):
        pc.LinearSystem(np.eye(2), np.eye(2))
    rounded = [str(warning.message) for warning in recwarn if "float64 data arrived" in str(warning.message)]
    assert len(rounded) == (0 if DOUBLE else 1)
