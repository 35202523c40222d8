"""The paper's Lemma 1 and the gradient of its Appendix B for one path, written out term by term.

Three readings are needed. The window [w]_{t-1}^H has the H blocks w_{t-1}, ..., w_{t-H} (the paper prints one
more). The products over j run backwards in time, the factor of the largest j on the left. Time-varying
A, B and K take the index of the step at which they act. The indicator 1_{j=t} of the paper never holds, as
j <= t-1: for i = t-1 it is the empty product that gives the identity.
"""

import numpy as np


def _window(w: np.ndarray, last: int, memory: int) -> np.ndarray:
    """[w]_last^H: the noises w_last, ..., w_{last-H+1} in one vector (H n,), zero before time 0."""
    n = w.shape[1]
    blocks = [w[last - i] if last - i >= 0 else np.zeros(n) for i in range(memory)]
    return np.concatenate(blocks)


def _product(A, B, K, deltas, first: int, last: int) -> np.ndarray:
    """The transition (A~_last + Delta_last) ... (A~_first + Delta_first), or I if first > last; (n, n)."""
    product = np.eye(A.shape[1])
    for j in range(first, last + 1):
        product = (A[j] - B[j] @ K[j] + deltas[j]) @ product
    return product


def _require_state_perturbations(A: np.ndarray, deltas: np.ndarray) -> None:
    """Refuse perturbations that act on the input too, which the paper does not have."""
    if deltas.shape != A.shape:
        raise ValueError(f"the printed formulas need perturbations of shape {A.shape}, not {deltas.shape}")


def printed_state(A, B, K, deltas, M, initial_state, w, t: int) -> np.ndarray:
    """The state x_t by Lemma 1, a sum over initial state, disturbance actions and noises.

    Args:
        A: (T, n, n). B: (T, n, m). K: (T + 1, m, n). deltas: (T, n, n). M: (H, m, n).
        initial_state: (n,). w: (T, n). t: a time from 0 to T.
    """
    A, B, K, deltas, M, w = (np.asarray(value, dtype=float) for value in (A, B, K, deltas, M, w))
    _require_state_perturbations(A, deltas)
    memory = M.shape[0]
    side_by_side = np.concatenate(list(M), axis=1)  # [M^(1), ..., M^(H)], (m, H n)
    state = _product(A, B, K, deltas, 0, t - 1) @ initial_state
    for i in range(t):
        product = _product(A, B, K, deltas, i + 1, t - 1)
        state = state + product @ B[i] @ side_by_side @ _window(w, i - 1, memory)
        state = state + product @ w[i]
    return state


def printed_gradient(A, B, K, deltas, x, w, M_shape, grad_x, grad_u) -> np.ndarray:
    """The gradient with respect to M of the total cost of one path, the stages t = 0..T of the paper's sum.

    Args:
        A: (T, n, n). B: (T, n, m). K: (T + 1, m, n). deltas: (T, n, n).
        x: states (T + 1, n); the formula meets them only through the stage gradients, so they are not read.
        w: (T, n). M_shape: (H, m, n).
        grad_x: gradients of the stage costs in the state along the path, (T + 1, n).
        grad_u: gradients of the stage costs in the input along the path, (T + 1, m).

    Returns:
        The gradient, (H, m, n).
    """
    del x
    A, B, K, deltas, w = (np.asarray(value, dtype=float) for value in (A, B, K, deltas, w))
    _require_state_perturbations(A, deltas)
    memory, m, n = M_shape
    horizon = A.shape[0]
    gradient = np.zeros((m, memory * n))  # of [M^(1), ..., M^(H)] side by side
    for t in range(horizon + 1):
        for i in range(t):
            product = _product(A, B, K, deltas, i + 1, t - 1)
            window = _window(w, i - 1, memory)
            gradient += np.outer((product @ B[i]).T @ grad_x[t], window)
            gradient -= np.outer((K[t] @ product @ B[i]).T @ grad_u[t], window)
        gradient += np.outer(grad_u[t], _window(w, t - 1, memory))
    return np.stack(np.split(gradient, memory, axis=1))
