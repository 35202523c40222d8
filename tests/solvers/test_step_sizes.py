"""Step sizes and schedules."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.solvers.step_sizes import as_step_size
from tests.oracles.performative_prediction import published_step_size
from tests.tools import assert_close, assert_refused

STEPS = jnp.arange(5)


def test_step_size_is_constant_when_a_number():
    assert_close([as_step_size(0.25)(n) for n in STEPS], np.full(5, 0.25))


@pytest.mark.float32
def test_inverse_step_is_phi1_over_n_plus_phi2():
    assert_close(pc.InverseStep(3.0, 7.0)(STEPS), 3 / (np.arange(5) + 7.0), single=1e-6)


@pytest.mark.float32
def test_power_step_falls_from_the_start_or_after_its_delay():
    n = np.arange(5)
    assert_close(pc.PowerStep(0.5, 0.6)(STEPS), 0.5 * (n + 1.0) ** -0.6, single=1e-6)
    assert_close(pc.PowerStep(0.5, 0.6, delay=20.0)(STEPS), 0.5 * 20**0.6 * (n + 20.0) ** -0.6, single=1e-6)


@pytest.mark.float32
def test_inverse_step_matches_the_published_schedule_counted_from_one():
    published = [published_step_size(t, 0.9) for t in range(1, 6)]
    assert_close(pc.InverseStep(10, 801)(STEPS), published, 1e-12, 1e-6)


def test_step_size_is_a_function_of_the_iteration():
    assert_close([as_step_size(lambda n: 1 / (n + 1) ** 2)(n) for n in STEPS], 1 / (np.arange(5) + 1.0) ** 2)


def test_step_size_keeps_modules_as_they_are():
    class Halving(eqx.Module):
        first: float

        def __call__(self, n):
            return self.first / 2**n

    halving = Halving(0.5)
    assert as_step_size(halving) is halving
    inverse = pc.InverseStep(1, 2)
    assert as_step_size(inverse) is inverse


@pytest.mark.parametrize("value", [0.0, -0.1, [0.1, 0.2]])
def test_step_size_is_refused_when_not_a_positive_number(value):
    assert_refused(lambda: pc.RSGD(10, value), "step_size", "positive number", "InverseStep")


def test_step_size_is_refused_when_not_finite():
    assert_refused(lambda: pc.RSGD(10, float("nan")), "step_size", "finite")


@pytest.mark.parametrize(("name", "phis"), [("phi1", (0, 1)), ("phi2", (1, -2)), ("phi1", ([1, 2], 1))])
def test_inverse_step_is_refused_when_not_positive(name, phis):
    assert_refused(lambda: pc.InverseStep(*phis), name, "positive number")


def test_lazy_schedule_deploys_every_so_many_steps():
    assert [bool(pc.Lazy(3).deploys(n)) for n in jnp.arange(7)] == [True, False, False, True, False, False, True]
    assert all(bool(pc.Greedy().deploys(n)) for n in STEPS)
    assert_refused(lambda: pc.Lazy(0), "steps", "at least 1")
