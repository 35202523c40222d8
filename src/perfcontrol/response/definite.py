"""Solves with a symmetric positive semidefinite matrix that say whether it is definite.

Small ones by their eigenvalues; large ones by Cholesky's factors, with the two extreme eigenvalues by power iteration
on the matrix and on its inverse.
"""

from typing import Any

import numpy as np
import scipy.linalg

from perfcontrol._programs import cond, numerics

EIGENVALUES = 512  # rows up to which all eigenvalues are computed
ROUNDS = 12  # of power iteration
INVERSE_ROUNDS = 4  # on the inverse: where the margin of `regular` is near, one eigenvalue outdoes all others


class Definite:
    """A PSD matrix (k, k).

    largest: its largest eigenvalue, where not all are computed an estimate a tenth above what power iteration finds.
    regular: whether it is definite beyond rounding; `solve` is good only then.
    """

    def __init__(self, matrix: Any):
        xp, linalg = numerics(matrix)
        self._linalg, self._size = linalg, len(matrix)
        margin = len(matrix) * xp.finfo(matrix.dtype).eps
        if len(matrix) <= EIGENVALUES:
            values, self._vectors = xp.linalg.eigh(matrix)
            self.largest, smallest = values[-1], values[0]
            self._values = xp.where(values > 0, values, 1)
        else:
            self._factor, definite = _cholesky(matrix, xp, linalg)
            self.largest = xp.minimum(1.1 * _power(lambda v: matrix @ v, len(matrix), ROUNDS, xp), xp.trace(matrix))
            inverse = _power(self._solve_columns, len(matrix), INVERSE_ROUNDS, xp)
            smallest = xp.where(definite, 1 / inverse, 0)
        self.regular = smallest > margin * self.largest

    def solve(self, right: Any) -> Any:
        """matrix⁻¹ right, for right (..., k, n)."""
        if self._size <= EIGENVALUES:
            return self._vectors @ ((self._vectors.T @ right) / self._values[:, None])
        solved = self._solve_columns(right.swapaxes(-1, -2).reshape(-1, self._size).T)
        return solved.T.reshape(*right.shape[:-2], right.shape[-1], self._size).swapaxes(-1, -2)

    def _solve_columns(self, columns: Any) -> Any:
        return self._linalg.cho_solve((self._factor, True), columns, check_finite=False)


def _cholesky(matrix: Any, xp: Any, linalg: Any) -> tuple[Any, Any]:
    """The lower factor, the identity in its place where there is none, and whether there is one."""
    try:
        factor = linalg.cholesky(matrix, lower=True)
    except scipy.linalg.LinAlgError:  # JAX gives NaN instead
        return np.eye(len(matrix), dtype=matrix.dtype), np.asarray(False)
    definite = xp.all(xp.isfinite(xp.diagonal(factor)))
    return cond(definite, lambda: factor, lambda: xp.eye(len(matrix), dtype=matrix.dtype)), definite


def _power(apply: Any, size: int, rounds: int, xp: Any) -> Any:
    """‖apply‖ from below, by power iteration from a vector that no structure is orthogonal to."""
    v = xp.asarray(np.random.default_rng(0).normal(size=size))
    norm = xp.linalg.norm(v)
    for _ in range(rounds):
        v = apply(v / xp.where(norm > 0, norm, 1))
        norm = xp.linalg.norm(v)
    return norm
