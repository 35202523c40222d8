"""Solves with semidefinite matrices, small and large, against dense NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from perfcontrol.response import definite
from perfcontrol.response.definite import Definite
from tests.tools import assert_close

RNG = np.random.default_rng(3)
ROOT = RNG.normal(size=(40, 40))


def _with_condition(exponent: float) -> np.ndarray:
    q, _ = np.linalg.qr(ROOT)
    matrix = (q * np.logspace(0, -exponent, 40)) @ q.T
    return (matrix + matrix.T) / 2


@pytest.fixture(params=["by eigenvalues", "by Cholesky"], autouse=True)
def limit(request, monkeypatch):
    monkeypatch.setattr(definite, "EIGENVALUES", 512 if request.param == "by eigenvalues" else 0)


@pytest.mark.parametrize("traced", [False, True])
def test_solve_matches_numpy_for_one_and_several_right_sides(traced):
    matrix, right = _with_condition(4.0), RNG.normal(size=(3, 40, 5))

    def answers(matrix, right):
        method = Definite(matrix)
        return method.solve(right), method.solve(right[0]), method.regular, method.largest

    several, one, regular, largest = (jax.jit(answers) if traced else answers)(matrix, right)
    assert_close(several, np.linalg.solve(matrix, right), 1e-11)
    assert_close(one, np.linalg.solve(matrix, right[0]), 1e-11)
    assert bool(regular) and 1 - 1e-9 <= float(largest) <= 1.1


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize(("exponent", "expected"), [(2.0, True), (12.0, True), (16.5, False)])
def test_matrix_is_regular_where_its_condition_is_clear_of_rounding(exponent, expected, traced):
    regular = (jax.jit if traced else lambda f: f)(lambda matrix: Definite(matrix).regular)
    assert bool(regular(_with_condition(exponent))) == expected


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("name", ["low rank", "zero", "zero row"])
def test_singular_matrix_is_not_regular(name, traced):
    matrix = {"low rank": ROOT[:, :7] @ ROOT[:, :7].T, "zero": np.zeros((40, 40)), "zero row": _with_condition(1.0)}[
        name
    ]
    if name == "zero row":
        matrix[3], matrix[:, 3] = 0, 0
    regular = (jax.jit if traced else lambda f: f)(lambda matrix: Definite(matrix).regular)
    assert not bool(regular(jnp.asarray(matrix) if traced else matrix))
