import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.cost import SizedCostContract
from tests.oracles.enumeration import stage_gradients
from tests.tools import assert_close, assert_refused, normal, random_psd

JOINT = random_psd(1, 5, 5)  # (T+1, n+m, n+m) for T = 4, n = 3, m = 2
TIME_VARYING = {
    "Q": JOINT[:, :3, :3],
    "R": JOINT[:, 3:, 3:],
    "cross": JOINT[:, :3, 3:],
    "state_target": normal(2, 5, 3),
    "input_target": normal(3, 5, 2),
}


class TestConstantWeights(SizedCostContract):
    def cost(self):
        return pc.QuadraticCost(random_psd(2, 3), random_psd(3, 2))


class TestConstantCrossAndTargets(SizedCostContract):
    def cost(self):
        return pc.QuadraticCost(
            JOINT[0, :3, :3], JOINT[0, 3:, 3:], JOINT[0, :3, 3:], state_target=[1.0, 0.0, -2.0], input_target=[0.5, 3.0]
        )


class TestTimeVaryingEverything(SizedCostContract):
    def cost(self):
        return pc.QuadraticCost(**TIME_VARYING)


class TestConstantAndTimeVaryingMixed(SizedCostContract):
    def cost(self):
        return pc.QuadraticCost(random_psd(2, 3), TIME_VARYING["R"], state_target=TIME_VARYING["state_target"])


class TestDiscounted(SizedCostContract):
    def cost(self):
        return pc.QuadraticCost(**TIME_VARYING, discount=0.8)


@pytest.mark.float32
def test_quadratic_cost_matches_the_dense_oracle():
    x, u = normal(4, 5, 3), normal(5, 5, 2)
    cost = pc.QuadraticCost(**TIME_VARYING)
    expected = stage_gradients(np.asarray(x)[None], np.asarray(u)[None], **TIME_VARYING)
    assert_close(cost.path_cost(x, u), expected[0][0], 1e-12, 1e-5)
    for value, reference in zip(cost.path_gradients(x, u), expected[1:], strict=True):
        assert_close(value, reference[0], 1e-12, 1e-5)


def test_quadratic_cost_has_no_factor_one_half():
    assert_close(
        pc.QuadraticCost([[2.0]], [[3.0]]).path_cost(normal(1, 1, 1) * 0 + 5, normal(1, 1, 1) * 0 + 7), [197.0]
    )


Q, R = np.eye(3), np.eye(2)


def check(*args, **kwargs):
    pc.QuadraticCost(*args, **kwargs).check(3, 2, 4)


COSTS_REFUSED = {
    "scalar Q": (lambda: pc.QuadraticCost(1.0, R), "Q", "square", "[[q]]"),
    "oblong R": (lambda: pc.QuadraticCost(Q, np.ones((2, 3))), "R", "(2, 3)"),
    "asymmetric Q": (lambda: pc.QuadraticCost([[1, 1], [0, 1]], [[1]]), "Q", "symmetric", "(Q + Q.T) / 2"),
    "indefinite Q": (lambda: pc.QuadraticCost(np.diag([1, -1, 1]), R), "Q", "semidefinite", "-1"),
    "indefinite R": (lambda: pc.QuadraticCost(Q, np.diag([1, -0.5])), "R", "-0.5"),
    "indefinite at one time": (lambda: pc.QuadraticCost(np.stack([Q, -Q]), R), "Q", "semidefinite"),
    "nan R": (lambda: pc.QuadraticCost(Q, [[np.nan]]), "R", "nan"),
    "cross swapped": (lambda: pc.QuadraticCost(Q, R, cross=np.zeros((2, 3))), "cross", "swapped"),
    "cross shape": (lambda: pc.QuadraticCost(Q, R, cross=np.zeros((3, 4))), "cross", "(3, 2)"),
    "cross too large": (lambda: pc.QuadraticCost(Q, R, cross=2 * np.ones((3, 2))), "cross", "semidefinite"),
    "lengths that differ": (
        lambda: pc.QuadraticCost(np.stack([Q] * 5), np.stack([R] * 4), cross=np.zeros((3, 2))),
        "R",
        "4",
        "5",
    ),
    "discount above one": (lambda: pc.QuadraticCost(Q, R, discount=1.1), "discount", "1.1", "(0, 1]"),
    "discount zero": (lambda: pc.QuadraticCost(Q, R, discount=0.0), "discount", "0.0"),
    "discounts": (lambda: pc.QuadraticCost(Q, R, discount=[0.9, 0.8]), "discount", "one number"),
    "length": (lambda: check(np.stack([Q] * 4), R), "Q", "(4, 3, 3)", "(5, 3, 3)"),
    "state target": (lambda: check(Q, R, state_target=[1.0, 2.0]), "state_target", "(2,)", "(3,)"),
    "input target": (lambda: check(Q, R, input_target=np.ones((4, 2))), "input_target", "(4, 2)", "(5, 2)"),
}


@pytest.mark.parametrize("case", COSTS_REFUSED.values(), ids=COSTS_REFUSED.keys())
def test_quadratic_cost_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
