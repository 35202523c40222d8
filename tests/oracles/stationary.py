"""Average cost per stage by a dense Lyapunov equation for the second moments of s_t = [x_t; w_{t-1}; ...; w_{t-H}]."""

import numpy as np


def extended(A, B, K, M, offset=None):
    """The matrix that takes s to x_{t+1} without noise, shifted lags below, and the one that takes s to [x; u].

    Args:
        A: (n, n). B: (n, m). K: (m, n). M: (H, m, n). offset: added to [A, B], (n, n+m), or None.
    """
    H, m, n = M.shape
    to_z = np.zeros((n + m, n * (H + 1)))
    to_z[:n, :n] = np.eye(n)
    to_z[n:, :n] = -K
    for i in range(H):
        to_z[n:, n * (i + 1) : n * (i + 2)] = M[i]
    joint = np.concatenate([A, B], axis=1) + (0 if offset is None else offset)
    step = np.zeros((n * (H + 1), n * (H + 1)))
    step[:n] = joint @ to_z
    for i in range(1, H):
        step[n * (i + 1) : n * (i + 2), n * i : n * (i + 1)] = np.eye(n)
    return step, to_z


def stationary_cost(A, B, K, M, mean, covariance, weight, linear, constant, directions=(), variances=(), offset=None):
    """The average cost per stage, and the spectral radius of the second moments.

    Args:
        A: (n, n). B: (n, m). K: (m, n). M: (H, m, n). mean, covariance: of w, (n,) and (n, n).
        weight, linear, constant: the stage cost zᵀ weight z + 2 linearᵀ z + constant on z = [x; u].
        directions: (k, n, n+m), acting on [x; u], with `variances` (k,). offset: E Δ on [x; u], (n, n+m), or None.
    """
    n = M.shape[2]
    step, to_z = extended(A, B, K, M, offset)
    size = len(step)
    enter = np.zeros((size, n))  # w becomes part of x and the first lag
    enter[:n] = enter[n : 2 * n] = np.eye(n)
    operator = np.kron(step, step)
    for D, variance in zip(directions, variances, strict=True):
        moved = np.zeros((size, size))
        moved[:n] = D @ to_z
        operator = operator + variance * np.kron(moved, moved)
    radius = np.abs(np.linalg.eigvals(operator)).max()
    s = np.linalg.solve(np.eye(size) - step, enter @ mean)
    mixed = np.outer(step @ s, enter @ mean)
    source = enter @ (covariance + np.outer(mean, mean)) @ enter.T + mixed + mixed.T
    second = np.linalg.solve(np.eye(size**2) - operator, source.ravel()).reshape(size, size)
    z = to_z @ s
    return float(np.trace(weight @ to_z @ second @ to_z.T) + 2 * linear @ z + constant), radius
