"""Feedback gains by the linear-quadratic regulator; sign convention u = -K x."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array

from perfcontrol._checks import as_array, check_shape, check_symmetric_psd, fail
from perfcontrol.systems.linear import LinearSystem


def design_gain(system: LinearSystem, *, Q: Any, R: Any) -> Array:
    """The gain K of u = -K x that minimises the sum of xᵀQx + uᵀRu without performativity.

    Time-invariant system: the stationary gain (m, n) of the discrete algebraic Riccati equation.
    System that varies in time: the gains (T+1, m, n) of the backward Riccati recursion from the terminal
    weight Q; the last one is zero, since the last input moves nothing.

    Args:
        system: the system.
        Q: (n, n), positive semidefinite state weight.
        R: (m, m), positive definite input weight.

    Raises:
        InputError: wrong shapes, indefinite weights, or no stabilising solution.
    """
    n, m = system.state_size, system.input_size
    Q, R = as_array("Q", Q), as_array("R", R)
    check_shape("Q", Q, (n, n), ("n", "n"))
    check_shape("R", R, (m, m), ("m", "m"))
    check_symmetric_psd("Q", Q, "Use a weight with no negative eigenvalue.")
    check_symmetric_psd("R", R, "Use a weight with positive eigenvalues only.")
    if float(np.linalg.eigvalsh(np.asarray(R, dtype=float)).min()) <= 0:
        raise fail(
            "R",
            "a matrix that is not positive definite",
            "be positive definite",
            "Add a small multiple of I.",
        )
    A, B = np.asarray(system.A, dtype=float), np.asarray(system.B, dtype=float)
    Q_host, R_host = np.asarray(Q, dtype=float), np.asarray(R, dtype=float)

    def gain(P: np.ndarray, A_t: np.ndarray, B_t: np.ndarray) -> np.ndarray:
        return np.linalg.solve(R_host + B_t.T @ P @ B_t, B_t.T @ P @ A_t)

    if system.horizon is None:
        try:
            P = scipy.linalg.solve_discrete_are(A, B, Q_host, R_host)
        except np.linalg.LinAlgError as error:
            raise fail(
                "system",
                f"no stabilising Riccati solution ({error})",
                "be stabilisable, with unstable modes seen by Q",
                "Weigh every unstable mode in Q, or pass your own gain.",
            ) from error
        return jnp.asarray(gain(P, A, B), dtype=float)
    horizon = system.horizon
    A, B = np.broadcast_to(A, (horizon, n, n)), np.broadcast_to(B, (horizon, n, m))
    gains, P = np.zeros((horizon + 1, m, n)), Q_host
    for t in reversed(range(horizon)):
        gains[t] = gain(P, A[t], B[t])
        closed = A[t] - B[t] @ gains[t]
        P = Q_host + gains[t].T @ R_host @ gains[t] + closed.T @ P @ closed
    return jnp.asarray(gains, dtype=float)
