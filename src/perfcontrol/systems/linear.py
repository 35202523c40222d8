"""The linear system x_{t+1} = A_t x_t + B_t u_t (+ perturbation and noise, which belong to the problem)."""

from typing import Any

import equinox as eqx
from jaxtyping import Array

from perfcontrol._checks import as_array, as_names, check_shape, fail
from perfcontrol._linalg import Diagonal


class LinearSystem(eqx.Module):
    """State matrix A and input matrix B, constant or one per time step.

    Args:
        A: (n, n) or (T, n, n).
        B: (n, m) or (T, n, m).
        state_names: n names of the states, or None.
        input_names: m names of the inputs, or None.

    Raises:
        InputError: shapes that do not fit, non-finite entries, or names that do not tell all signals apart.
    """

    A: Array | Diagonal
    B: Array | Diagonal
    state_names: tuple[str, ...] | None = eqx.field(static=True)
    input_names: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(self, A: Any, B: Any, state_names: Any = None, input_names: Any = None):
        self.A = A if isinstance(A, Diagonal) else as_array("A", A)
        self.B = B if isinstance(B, Diagonal) else as_array("B", B)
        if self.A.ndim not in (2, 3):
            raise fail("A", f"{self.A.shape}", "have shape (n, n) or (T, n, n)", "Pass [[a]] for a scalar system.")
        if self.B.ndim not in (2, 3):
            raise fail(
                "B",
                f"{self.B.shape}",
                "have shape (n, m) or (T, n, m)",
                "Pass a single input as a column, such as [[b1], [b2]].",
            )
        n = self.A.shape[-1]
        check_shape("A", self.A, (*self.A.shape[:-2], n, n), ("time",) * (self.A.ndim - 2) + ("n", "n"))
        if self.B.shape[-2] != n:
            hint = (
                "The last two axes look swapped: pass its transpose."
                if self.B.shape[-1] == n
                else "B has one row per state."
            )
            raise fail("B", f"{self.B.shape}", f"have {n} rows, as A has", hint)
        if self.A.ndim == 3 and self.B.ndim == 3 and self.A.shape[0] != self.B.shape[0]:
            raise fail(
                "B",
                f"{self.B.shape[0]} time steps",
                f"have {self.A.shape[0]} time steps, as A has",
                "Give both the same length, or one of them constant.",
            )

        self.state_names = as_names("state_names", state_names, n)
        self.input_names = as_names("input_names", input_names, self.B.shape[-1])

    @classmethod
    def diagonal(cls, a: Any, b: Any) -> "LinearSystem":
        """The decoupled system x_i ← a_i x_i + b_i u_i: products with A and B then cost O(n) everywhere.

        Args:
            a: (n,) or (T, n).
            b: likewise.
        """
        diagonals = []
        for name, value in (("a", as_array("a", a)), ("b", as_array("b", b))):
            if value.ndim not in (1, 2):
                raise fail(name, f"{value.shape}", "have shape (n,) or (T, n)", "Pass the diagonal alone.")
            diagonals.append(Diagonal(value))
        return cls(*diagonals)

    @property
    def state_size(self) -> int:
        """n."""
        return self.A.shape[-1]

    @property
    def input_size(self) -> int:
        """m."""
        return self.B.shape[-1]

    @property
    def horizon(self) -> int | None:
        """T where a matrix varies in time, else None."""
        return self.A.shape[0] if self.A.ndim == 3 else self.B.shape[0] if self.B.ndim == 3 else None
