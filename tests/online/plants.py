"""Plants to run a controller on: plain NumPy loops over given draws."""

import jax
import numpy as np

from perfcontrol.evaluate.rollout import draw_path


def drawn(problem, deployed, key):
    """x_0, w (T, n) and Δ (T, n, p) of one path, as NumPy arrays."""
    x0, w, draws = draw_path(problem, problem.structure.lift(jax.numpy.asarray(deployed)), key)
    return np.asarray(x0), np.asarray(w), np.asarray(draws.dense())


def system_at(problem, t):
    """A_t and B_t."""
    A, B = np.asarray(problem.system.A), np.asarray(problem.system.B)
    return A[t] if A.ndim == 3 else A, B[t] if B.ndim == 3 else B


def run_episode(controller, state, problem, draws, observed=True):
    """The state after one episode with these draws, end_episode included."""
    x, w, deltas = draws
    n = len(x)
    for t in range(len(w)):
        u = np.asarray(controller.act(state, x))
        A, B = system_at(problem, t)
        full = np.concatenate([A, B], axis=1)[:, : deltas.shape[2]] + deltas[t]
        on_input = full[:, n:] if full.shape[1] > n else B
        following = full[:, :n] @ x + on_input @ u + w[t]
        state = controller.observe(state, x, u, following, full if observed else None)
        x = following
    return controller.end_episode(state)
