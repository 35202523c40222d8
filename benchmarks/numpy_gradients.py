"""What a reader of the paper would write in NumPy: the baselines of the speed table."""

import numpy as np


def printed(A, B, K, deltas, x, w, H, grad_x, grad_u):
    """(a) The printed formula (Appendix B, "grad M ct"), each product of closed loops extended by one factor: O(T²)."""
    T, n = w.shape
    windows = np.zeros((T + 1, H, n))
    for i in range(1, H + 1):
        windows[i:, i - 1] = w[: T + 1 - i]
    windows = windows.reshape(T + 1, H * n)
    gradient = np.zeros((B.shape[1], H * n))
    for t in range(T + 1):
        product = np.eye(n)
        for i in reversed(range(t)):
            through = product @ B
            gradient += np.outer(through.T @ grad_x[t], windows[i])
            gradient -= np.outer((K @ through).T @ grad_u[t], windows[i])
            product = product @ (A - B @ K + deltas[i])
        gradient += np.outer(grad_u[t], windows[t])
    return gradient


def adjoint(A, B, K, deltas, x, w, H, grad_x, grad_u):
    """(b) The same numbers in O(T), by the adjoint recursion, one Python step a time step."""
    T, n = w.shape
    source = grad_x - grad_u @ K
    y = np.empty((T + 1, n))
    y[T] = source[T]
    for t in reversed(range(T)):
        y[t] = source[t] + (A - B @ K + deltas[t]).T @ y[t + 1]
    h = grad_u.copy()
    h[:-1] += y[1:] @ B
    return np.stack([h[i:].T @ w[: T + 1 - i] for i in range(1, H + 1)])
