import cvxpy as cp
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.contracts.feasible_set import SetContract
from tests.tools import assert_close, assert_refused, normal

TOTALS = np.array([[0.5, 2.0], [0.0, 1.0]])


def row_sums(M, totals):
    return [cp.sum(lag, axis=1) == total for lag, total in zip(M, totals, strict=True)]


class TestRowSum(SetContract):
    def feasible_set(self):
        return pc.RowSum(-0.7)

    def constraints(self, M):
        return row_sums(M, np.full((2, 2), -0.7))


class TestRowSumOfOneTotalARow(SetContract):
    def feasible_set(self):
        return pc.RowSum(TOTALS)

    def constraints(self, M):
        return row_sums(M, TOTALS)


class TestRowSimplex(SetContract):
    def feasible_set(self):
        return pc.RowSimplex(1.5)

    def constraints(self, M):
        return [*row_sums(M, np.full((2, 2), 1.5)), *(lag >= 0 for lag in M)]


class TestRowSimplexOfOneTotalARow(SetContract):
    def feasible_set(self):
        return pc.RowSimplex(TOTALS)

    def constraints(self, M):
        return [*row_sums(M, TOTALS), *(lag >= 0 for lag in M)]


class TestRowSimplexOfOneColumn(SetContract):
    shape = (1, 3, 1)

    def feasible_set(self):
        return pc.RowSimplex(0.4)

    def constraints(self, M):
        return [*row_sums(M, np.full((1, 3), 0.4)), *(lag >= 0 for lag in M)]


def test_row_simplex_projection_handles_ties_and_vertices():
    simplex = pc.RowSimplex(1.0)
    assert_close(simplex.project(jnp.full((1, 1, 4), 7.0)), jnp.full((1, 1, 4), 0.25))
    assert_close(simplex.project(jnp.array([[[9.0, 0.0, -9.0]]])), jnp.array([[[1.0, 0.0, 0.0]]]))


def test_row_simplex_radius_and_support_are_attained_at_vertices():
    simplex = pc.RowSimplex(TOTALS)
    direction = normal(3, 2, 2, 3)
    vertex = TOTALS[..., None] * np.eye(3)[np.argmax(direction, axis=-1)]
    assert_close(simplex.support(direction), np.sum(vertex * np.asarray(direction)))
    assert_close(simplex.radius((2, 2, 3)), np.linalg.norm(vertex))


ROWS_REFUSED = {
    "negative simplex": (lambda: pc.RowSimplex(-0.1), "total", "empty"),
    "one negative row": (lambda: pc.RowSimplex([[1.0, -2.0]]), "total", "-2"),
    "totals that do not fit": (lambda: pc.RowSum(TOTALS).check((2, 3, 3)), "total", "(2, 2)", "(2, 3)"),
    "simplex that does not fit": (lambda: pc.RowSimplex([1.0, 1.0]).check((1, 2, 3)), "total", "(2,)", "(1, 2)"),
    "nan": (lambda: pc.RowSum(np.nan), "total", "finite"),
}


@pytest.mark.parametrize("case", ROWS_REFUSED.values(), ids=ROWS_REFUSED.keys())
def test_row_set_is_refused_with_a_four_part_error(case):
    assert_refused(*case)
