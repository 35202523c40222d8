"""Ready-made stage functions against NumPy, and what `ConvexCost` finds out about functions on samples."""

import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.cost import CostContract
from tests.tools import assert_close, assert_refused, normal

Q, R = np.array([1.0, 0.5, 2.0]), np.array([0.3, 1.5])
TARGETS = {"state_target": [0.5, 0.0, -1.0], "input_target": 0.2}
FUNCTIONS = {
    "huber": lambda: pc.Huber(0.7, Q, R, **TARGETS),
    "log-cosh": lambda: pc.LogCosh(0.7, Q, R, **TARGETS),
    "above": lambda: pc.OneSidedQuadratic("above", Q, R, **TARGETS),
    "below": lambda: pc.OneSidedQuadratic("below", Q, R, **TARGETS),
    "linear-exponential": lambda: pc.LinearExponential([0.5, -0.5, 1.0], Q, R, **TARGETS),
}


def square(z):
    return z**2


def huber(z):
    return np.where(np.abs(z) <= 0.7, z**2, 0.7 * (2 * np.abs(z) - 0.7))


def log_cosh(z):
    return 2 * 0.7**2 * np.log(np.cosh(z / 0.7))


def linear_exponential(z):
    a = np.array([0.5, -0.5, 1.0])
    return 2 / a**2 * (np.exp(a * z) - a * z - 1)


ORACLES = {
    "huber": (huber, huber),
    "log-cosh": (log_cosh, log_cosh),
    "above": (lambda z: np.where(z > 0, z, 0) ** 2, square),
    "below": (lambda z: np.where(z < 0, z, 0) ** 2, square),
    "linear-exponential": (linear_exponential, square),
}


class TestHuber(CostContract):
    difference_tolerance = 1e-5  # the gradient has kinks

    def cost(self):
        return pc.ConvexCost(FUNCTIONS["huber"]())


class TestLogCosh(CostContract):
    difference_tolerance = 1e-6

    def cost(self):
        return pc.ConvexCost(FUNCTIONS["log-cosh"]())


class TestOneSidedQuadratic(CostContract):
    difference_tolerance = 1e-5

    def cost(self):
        return pc.ConvexCost(FUNCTIONS["above"](), discount=0.9)


class TestLinearExponential(CostContract):
    difference_tolerance = 1e-6

    def cost(self):
        return pc.ConvexCost(FUNCTIONS["linear-exponential"]())


@pytest.mark.float32
@pytest.mark.parametrize("name", FUNCTIONS)
def test_function_is_the_weighted_sum_of_its_numpy_oracle(name):
    x, u = np.asarray(2 * normal(1, 6, 3)), np.asarray(2 * normal(2, 6, 2))
    of_state, of_input = ORACLES[name]
    expected = of_state(x - np.array(TARGETS["state_target"])) @ Q + of_input(u - 0.2) @ R
    assert_close(pc.ConvexCost(FUNCTIONS[name]()).path_cost(jnp.asarray(x), jnp.asarray(u)), expected, 1e-12, 1e-5)


@pytest.mark.parametrize(
    "function",
    [pc.Huber(1e6, Q, R), pc.LogCosh(1e5, Q, R), pc.LinearExponential(1e-5, Q, R)],
    ids=["huber", "log-cosh", "linear-exponential"],
)
def test_function_nears_the_quadratic_in_its_limit(function):
    x, u = normal(1, 6, 3), normal(2, 6, 2)
    exact, near = pc.QuadraticCost(np.diag(Q), np.diag(R)), pc.ConvexCost(function)
    assert_close(near.path_cost(x, u), exact.path_cost(x, u), 1e-4, 1e-2)
    for value, reference in zip(near.path_gradients(x, u), exact.path_gradients(x, u), strict=True):
        assert_close(value, reference, 1e-4, 1e-2)


def test_log_cosh_neither_overflows_far_out_nor_loses_digits_near_zero():
    cost = pc.ConvexCost(pc.LogCosh(1.0))
    x = jnp.asarray([[1e4], [1e-6]])
    assert_close(cost.path_cost(x, 0 * x), [2e4 - 2 * np.log(2), 1e-12], 1e-12, 1e-6)
    assert float(cost.path_cost(x, 0 * x)[1]) == pytest.approx(1e-12, rel=1e-9)
    assert_close(cost.path_gradients(x, 0 * x)[0][:, 0], [2.0, 2e-6], 1e-12)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_declared_constants_hold_between_any_two_points(name):
    untargeted = {
        "huber": pc.Huber(0.7, Q, R),
        "log-cosh": pc.LogCosh(0.7, Q, R),
        "above": pc.OneSidedQuadratic("above", Q, R),
        "below": pc.OneSidedQuadratic("below", Q, R),
        "linear-exponential": pc.LinearExponential(0.5, Q, R),
    }[name]
    cost = pc.ConvexCost(untargeted)
    assert cost.strong_convexity == 0
    x, u = 3 * normal(3, 400, 3), 3 * normal(4, 400, 2)
    gradients = np.concatenate(cost.path_gradients(x, u), axis=1)
    z = np.concatenate([x, u], axis=1)
    moved, turned = (np.linalg.norm(np.diff(part, axis=0), axis=1) for part in (z, gradients))
    if name == "linear-exponential":
        assert cost.smoothness is None and cost.gradient_bound is None
        return
    assert cost.smoothness == 4.0 and cost.gradient_bound is not None
    assert np.max(turned / moved) <= 4.0
    for part, weighed in ((x, gradients[:, :3]), (u, gradients[:, 3:])):
        reach = np.maximum(np.linalg.norm(x, axis=1), np.linalg.norm(u, axis=1))
        assert np.all(np.linalg.norm(weighed, axis=1) <= float(cost.gradient_bound) * reach + 1e-12), part
    assert pc.ConvexCost(FUNCTIONS[name]()).gradient_bound is None  # targets shift it


def paths():
    return normal(5, 4, 5, 3), normal(6, 4, 5, 2)


def looked_at(function, **constants):
    return lambda: pc.ConvexCost(function, **constants).check_convexity(*paths())


def late_saddle(t, x, u):
    return x @ x + u @ u - jnp.where(t == 4, 3.0, 0.0) * x[1] ** 2


FOUND = {
    "saddle at one stage": (looked_at(late_saddle), "function", "eigenvalue -4", "t = 4", "x = [", "convex", "RSGD"),
    "concave kink": (
        looked_at(lambda t, x, u: x @ x + u @ u - 3 * jnp.sum(jnp.abs(u))),
        "function",
        "turn back",
        "u = [",
    ),
    "no derivative": (looked_at(lambda t, x, u: jnp.sum(jnp.sqrt(jnp.maximum(x, 0)))), "function", "finite", "Smooth"),
    "too strong": (
        looked_at(lambda t, x, u: x @ x + 2 * u @ u, strong_convexity=2.1),
        "strong_convexity",
        "2.1",
        "curvature of 2 was",
    ),
    "not that smooth": (looked_at(lambda t, x, u: x @ x + 2 * u @ u, smoothness=3.0), "smoothness", "curvature of 4"),
}


@pytest.mark.parametrize("case", FOUND.values(), ids=FOUND.keys())
def test_a_function_that_is_not_what_it_should_be_is_refused_with_the_point(case):
    assert_refused(*case)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_ready_made_functions_pass_the_look_at_convexity(name):
    pc.ConvexCost(FUNCTIONS[name]()).check_convexity(*paths())


REFUSED = {
    "threshold": (lambda: pc.Huber(0.0), "threshold", "positive"),
    "thresholds": (lambda: pc.Huber([1.0, 2.0]), "threshold", "one positive number"),
    "scale": (lambda: pc.LogCosh(-1.0), "scale", "-1.0"),
    "risk": (lambda: pc.LinearExponential(0.0), "risk", "zero"),
    "side": (lambda: pc.OneSidedQuadratic("left"), "side", "left"),
    "weight": (lambda: pc.Huber(1.0, state_weight=[1.0, -1.0]), "state_weight", "-1"),
    "matrix": (lambda: pc.Huber(1.0, input_weight=np.eye(2)), "input_weight", "vector"),
    "misfit": (lambda: pc.ConvexCost(pc.Huber(1.0, Q, R)).check(2, 2, 4), "function", "error"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_function_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
