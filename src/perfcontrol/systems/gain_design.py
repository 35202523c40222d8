"""Feedback gains by the linear-quadratic regulator; sign convention u = -K x."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array

from perfcontrol._checks import as_array, check_instance, check_shape, check_symmetric_psd, fail
from perfcontrol.systems.linear import LinearSystem


def design_gain(system: LinearSystem, *, Q: Any, R: Any, directions: Any = None, variances: Any = None) -> Array:
    """The gain K of u = -K x that minimises the sum of xᵀQx + uᵀRu without performativity.

    Time-invariant system: the stationary gain (m, n) of the discrete algebraic Riccati equation.
    System that varies in time: the gains (T+1, m, n) of the backward Riccati recursion from the terminal
    weight Q; the last one is zero, since the last input moves nothing.

    With multiplicative noise Σ_k ζ_{tk} D_k x_t (ζ independent, of mean zero and variance v_k) the recursion is the
    generalised one, P = Q + KᵀRK + (A-BK)ᵀP(A-BK) + Σ_k v_k D_kᵀPD_k, iterated until it settles.

    Args:
        system: the system.
        Q: (n, n), positive semidefinite state weight.
        R: (m, m), positive definite input weight.
        directions: D_k, (k, n, n), of the multiplicative noise; None for none.
        variances: v_k, (k,) or a number.

    Raises:
        InputError: wrong shapes, indefinite weights, or no (mean-square) stabilising solution.

    References:
        Gravell, Esfahani and Summers 2019 for multiplicative noise.
    """
    check_instance("system", system, LinearSystem, "pc.LinearSystem(A, B)")
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

    spread = _multiplicative_noise(directions, variances, n)
    if system.horizon is None and spread is not None:
        return jnp.asarray(_generalised_riccati(A, B, Q_host, R_host, *spread), dtype=float)
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
        reaction = 0 if spread is None else np.einsum("k,kba,bc,kcd->ad", spread[1], spread[0], P, spread[0])
        P = Q_host + gains[t].T @ R_host @ gains[t] + closed.T @ P @ closed + reaction
    return jnp.asarray(gains, dtype=float)


def _multiplicative_noise(directions: Any, variances: Any, n: int) -> tuple[np.ndarray, np.ndarray] | None:
    """D (k, n, n) and v (k,) after checks; None where no directions are given."""
    if directions is None:
        if variances is not None:
            raise fail("variances", "variances without directions", "come with `directions`", "Pass both or neither.")
        return None
    D = as_array("directions", directions)
    check_shape("directions", D, (D.shape[0] if D.ndim else 0, n, n), ("k", "n", "n"), "A single D is passed as [D].")
    v = np.broadcast_to(np.asarray(as_array("variances", 1.0 if variances is None else variances)), (D.shape[0],))
    if np.any(v < 0):
        raise fail("variances", f"{v.min():.4g}", "be non-negative", "Pass variances, not signed scales.")
    return np.asarray(D, dtype=float), np.asarray(v, dtype=float)


def _generalised_riccati(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, D: np.ndarray, v: np.ndarray, limit: int = 100_000
) -> np.ndarray:
    """The stationary gain by value iteration from P = Q, which increases to the least solution if there is one."""
    P = Q
    for _ in range(limit):
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        closed = A - B @ K
        following = Q + K.T @ R @ K + closed.T @ P @ closed + np.einsum("k,kba,bc,kcd->ad", v, D, P, D)
        if not np.all(np.isfinite(following)) or np.abs(following).max() > 1e12 * max(1.0, np.abs(Q).max()):
            break
        if np.abs(following - P).max() <= 1e-14 * np.abs(following).max():
            return np.linalg.solve(R + B.T @ following @ B, B.T @ following @ A)
        P = following
    raise fail(
        "variances",
        "multiplicative noise that no gain stabilises in mean square (the Riccati iteration grows)",
        "be small enough for a finite cost",
        "Reduce the variances, or add inputs.",
    )
