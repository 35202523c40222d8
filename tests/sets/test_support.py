import cvxpy as cp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.feasible_set import SetContract
from tests.tools import assert_close, assert_refused, normal

MASK = np.array([[[True, False, True], [False, True, True]], [[False, False, True], [True, True, False]]])


class TestSupport(SetContract):
    def feasible_set(self):
        return pc.Support(MASK)

    def constraints(self, M):
        return [cp.multiply(~MASK[i], lag) == 0 for i, lag in enumerate(M)]


class TestSupportOfEveryLag(SetContract):
    def feasible_set(self):
        return pc.Support(MASK[0].astype(int))

    def constraints(self, M):
        return [cp.multiply(~MASK[0], lag) == 0 for lag in M]


def test_support_projection_zeroes_the_masked_entries_alone():
    M = normal(1, 2, 2, 3)
    assert_close(pc.Support(MASK).project(M), np.where(MASK, M, 0), 0, 0)


REFUSED = {
    "fractions": (lambda: pc.Support([[0.5, 1.0]]), "mask", "True and False"),
    "a vector": (lambda: pc.Support([True, False]), "mask", "(2,)", "(input, state)"),
    "misfit": (lambda: pc.Support(MASK).check((2, 3, 3)), "mask", "(2, 2, 3)", "(2, 3, 3)"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED.keys())
def test_support_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
