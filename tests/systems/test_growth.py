"""Closed loops that grow by themselves: the number, and when it is said."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.systems import growth as room
from perfcontrol.systems.growth import growth, warn_of_growth
from tests.tools import DOUBLE, normal


@pytest.fixture(autouse=True)
def unheard(monkeypatch):
    monkeypatch.setattr(room, "_looked_at", set())


def problem(gain, a=0.9):
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[a]], [[1.0]]),
        horizon=3,
        noise=pc.Gaussian([0.0], [[1.0]]),
        cost=pc.QuadraticCost([[1.0]], [[1.0]]),
        gain=gain,
    )


def heard(call):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        call()
    return [word for word in said if issubclass(word.category, pc.UnstableGainWarning)]


def test_growth_of_a_constant_loop_is_the_limit_of_its_powers():
    loop = np.asarray(normal(1, 3, 3), dtype=float)
    power = np.linalg.norm(np.linalg.matrix_power(loop, 400)) ** (1 / 400)
    assert abs(growth(loop) / power - 1) < 0.02


@pytest.mark.parametrize("scale", [1.0, 1e-60, 1e60])
def test_growth_of_a_varying_loop_is_that_of_its_product_per_step(scale):
    loops = np.asarray(normal(2, 7, 3, 3), dtype=float)
    product = np.linalg.multi_dot(loops[::-1])
    expected = np.max(np.abs(np.linalg.eigvals(product))) ** (1 / 7)
    assert growth(scale * loops) == pytest.approx(scale * expected, rel=1e-9)


def test_growth_of_a_loop_that_forgets_everything_is_zero():
    nilpotent = np.array([[0.0, 1.0], [0.0, 0.0]])
    assert growth(nilpotent) == growth(np.stack([nilpotent, nilpotent])) == growth(np.zeros((4, 2, 2))) == 0


@pytest.mark.parametrize("use", [lambda p: pc.solve(p, pc.StablePoint()), pc.certify], ids=["solve", "certify"])
def test_gain_that_destabilises_is_said_once_with_the_number_where_a_problem_is_solved_or_certified(use):
    built = problem(gain=[[-0.5]])
    (said,) = heard(lambda: use(built))
    assert "spectral radius of 1.4 > 1" in str(said.message) and "u = -K x" in str(said.message)
    assert said.filename == __file__ or "jaxtyping" in said.filename  # which may stand between, in tests
    assert not heard(lambda: use(problem(gain=[[-0.5]])))
    assert heard(lambda: use(problem(gain=[[-0.25]])))


def test_gain_that_varies_is_judged_by_the_product_over_the_horizon():
    calm, wild = 0.2 * np.ones((4, 1, 1)), -0.5 * np.ones((4, 1, 1))
    once = np.concatenate([wild[:1], calm[1:]])  # 1.4 · 0.7 · 0.7 < 1
    slow = np.array([-0.5, 0.0, 0.0, -9.0]).reshape(4, 1, 1)  # 1.4 · 0.9 · 0.9 = 1.134; K_T moves no state
    assert not heard(lambda: pc.solve(problem(once), pc.StablePoint()))
    (said,) = heard(lambda: pc.solve(problem(slow), pc.StablePoint()))
    assert f"of {1.134 ** (1 / 3):.6g} > 1" in str(said.message)


def test_nothing_is_said_of_stable_loops_nor_where_no_gain_was_given():
    assert not heard(lambda: pc.solve(problem(gain=[[0.5]]), pc.StablePoint()))
    assert not heard(lambda: pc.solve(problem(gain=0, a=1.5), pc.StablePoint()))


def test_nothing_is_said_of_a_marginal_loop_whatever_the_rounding():
    A, B, K = np.array([[1.0, 1.0], [-1e-18, 1.0]]), np.eye(2), np.zeros((2, 2))
    assert not heard(lambda: warn_of_growth(jnp.asarray(A), jnp.asarray(B), jnp.asarray(K)))
    turned = np.linalg.qr(normal(3, 2, 2))[0]
    assert not heard(lambda: warn_of_growth(*map(jnp.asarray, (turned @ A @ turned.T, B, K))))


def test_nothing_is_said_under_a_trace():
    def stable(gain):
        return pc.solve(problem(gain), pc.StablePoint()).M

    assert not heard(lambda: jax.eval_shape(stable, jnp.array([[-0.5]])))


@pytest.mark.skipif(not DOUBLE, reason="a difference that single precision does not see")
def test_growth_a_little_above_one_is_said():
    A, B, K = 1.00001 * jnp.eye(2), jnp.eye(2), jnp.zeros((2, 2))
    assert len(heard(lambda: warn_of_growth(A, B, K))) == 1


def test_warning_can_be_silenced_by_its_category():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=pc.UnstableGainWarning)
        pc.solve(problem(gain=[[-0.5]]), pc.StablePoint())
