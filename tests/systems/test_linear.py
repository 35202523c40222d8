import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.tools import assert_close, assert_refused, normal


@pytest.mark.float32
def test_linear_system_knows_its_sizes_and_horizon():
    constant, varying = normal(1, 3, 3), normal(2, 5, 3, 2)
    assert pc.LinearSystem(constant, varying[0]).horizon is None
    system = pc.LinearSystem(constant, varying)
    assert (system.state_size, system.input_size, system.horizon) == (3, 2, 5)
    assert pc.LinearSystem(normal(1, 5, 3, 3), varying).horizon == 5
    assert system.A.dtype == jnp.result_type(float)


def test_linear_system_takes_anything_array_like():
    assert_close(pc.LinearSystem([[1, 0], [0, 1]], [[1], [0]]).A, np.eye(2), 0, 0)


def test_diagonal_system_is_the_dense_one():
    a, b = normal(1, 3), normal(2, 4, 3)
    system = pc.LinearSystem.diagonal(a, b)
    assert (system.state_size, system.input_size, system.horizon) == (3, 3, 4)
    assert_close(np.asarray(system.A), np.diag(a), 0, 0)
    assert_close(np.asarray(system.B), np.stack([np.diag(row) for row in np.asarray(b)]), 0, 0)
    x = normal(3, 3)
    assert_close(system.A @ x[:, None], np.diag(a) @ np.asarray(x)[:, None])
    dense = normal(4, 3, 3)
    assert_close(dense @ system.A, np.asarray(dense) @ np.diag(a))
    assert_close(system.A + dense, np.diag(a) + np.asarray(dense))


SYSTEMS_REFUSED = {
    "scalar A": (lambda: pc.LinearSystem(1.0, [[1.0]]), "A", "[[a]]"),
    "vector B": (lambda: pc.LinearSystem([[1.0]], [1.0]), "B", "column"),
    "oblong A": (lambda: pc.LinearSystem(np.ones((2, 3)), np.ones((2, 1))), "A", "(2, 3)"),
    "B swapped": (lambda: pc.LinearSystem(np.eye(3), np.ones((1, 3))), "B", "swapped", "3 rows"),
    "B rows": (lambda: pc.LinearSystem(np.eye(3), np.ones((2, 1))), "B", "(2, 1)", "one row per state"),
    "lengths": (lambda: pc.LinearSystem(np.ones((4, 1, 1)), np.ones((5, 1, 1))), "B", "5 time steps", "4 time steps"),
    "nan": (lambda: pc.LinearSystem([[0.0, 1.0], [np.nan, 0.0]], np.eye(2)), "A", "nan at index [1, 0]"),
    "infinite": (lambda: pc.LinearSystem([[1.0]], [[np.inf]]), "B", "inf at index [0, 0]"),
    "ragged": (lambda: pc.LinearSystem([[1.0], [1.0, 2.0]], np.eye(2)), "A", "rectangular"),
    "matrix as diagonal": (lambda: pc.LinearSystem.diagonal(np.ones((1, 2, 2)), [1.0, 1.0]), "a", "(1, 2, 2)"),
}


@pytest.mark.parametrize("case", SYSTEMS_REFUSED.values(), ids=SYSTEMS_REFUSED.keys())
def test_linear_system_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
