"""Infinite-horizon cost of a fixed gain u = -K x under multiplicative noise, and the Riccati gains.

The system is x_{t+1} = (A + sum_k d_{tk} D_k) x_t + B u_t with independent d_{tk} of mean 0 and variance v_k.
"""

import numpy as np
import scipy.linalg


def infinite_horizon_cost(A, B, K, directions, variances, Q, R) -> tuple[float, np.ndarray]:
    """The cost summed to infinity from E x_0 x_0' = I, and the matrix P of the cost x_0' P x_0.

    P = Q + K'RK + (A - BK)' P (A - BK) + sum_k v_k D_k' P D_k, one linear system in the n^2 entries of P.

    Args:
        A: (n, n). B: (n, m). K: (m, n), for u = -K x. directions: D (k, n, n). variances: (k,).
        Q: (n, n). R: (m, m).

    Returns:
        tr P and P (n, n).

    Raises:
        ValueError: the gain does not stabilise the system in mean square, so the cost is infinite.
    """
    n = A.shape[0]
    closed_loop = A - B @ K
    operator = np.kron(closed_loop.T, closed_loop.T)  # of vec(P), row-major: vec(X' P X) = (X' kron X') vec(P)
    for direction, variance in zip(directions, variances, strict=True):
        operator = operator + variance * np.kron(direction.T, direction.T)
    if np.abs(np.linalg.eigvals(operator)).max() >= 1:
        raise ValueError("the gain does not stabilise the system in mean square")
    stage = Q + K.T @ R @ K
    P = np.linalg.solve(np.eye(n * n) - operator, stage.ravel()).reshape(n, n)
    return float(np.trace(P)), P


def riccati_gain(A, B, Q, R) -> np.ndarray:
    """The optimal gain (m, n), for u = -K x, without multiplicative noise.

    Args:
        A: (n, n). B: (n, m). Q: (n, n). R: (m, m).
    """
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def generalised_riccati_gain(A, B, directions, variances, Q, R, iterations: int = 10_000) -> np.ndarray:
    """The optimal gain (m, n), for u = -K x, under multiplicative noise, by value iteration from P = 0.

    Args:
        A: (n, n). B: (n, m). directions: D (k, n, n). variances: (k,). Q: (n, n). R: (m, m).
        iterations: the most steps to take.

    Raises:
        ValueError: no convergence to a relative change of 1e-14 within the given steps.
    """
    P = np.zeros_like(Q, dtype=float)
    for _ in range(iterations):
        gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        following = Q + gain.T @ R @ gain + (A - B @ gain).T @ P @ (A - B @ gain)
        for direction, variance in zip(directions, variances, strict=True):
            following = following + variance * direction.T @ P @ direction
        if np.abs(following - P).max() <= 1e-14 * np.abs(following).max():
            return np.linalg.solve(R + B.T @ following @ B, B.T @ following @ A)
        P = following
    raise ValueError("value iteration did not converge")
