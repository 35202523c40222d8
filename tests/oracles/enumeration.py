"""Exact expected cost and its exact gradient, summed over every joint outcome of finitely supported laws.

The gradient is carried forward along each path as the sensitivity dx_t/dM; there is no adjoint here.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

FiniteLaw = tuple[np.ndarray, np.ndarray]
"""Atoms, stacked on the first axis, and their probabilities."""


class Paths(NamedTuple):
    """Every joint outcome, one a row: p probabilities, and what is drawn on each of the p paths.

    Shapes: probability (p,), initial_state (p, n), noise (p, T, n), perturbation (p, T, n, n or n + m).
    """

    probability: np.ndarray
    initial_state: np.ndarray
    noise: np.ndarray
    perturbation: np.ndarray


def enumerate_paths(noise: Sequence[FiniteLaw], perturbations: Sequence[FiniteLaw], initial: FiniteLaw) -> Paths:
    """Every combination of one atom of x_0, of each w_t and of each Delta_t, with the product probability.

    Args:
        noise: for each t = 0..T-1 the atoms (k, n) of w_t and their probabilities (k,).
        perturbations: for each t = 0..T-1 the atoms (j, n, n) or (j, n, n + m) of Delta_t and their
            probabilities (j,).
        initial: the atoms (l, n) of x_0 and their probabilities (l,).
    """
    if len(noise) != len(perturbations):
        raise ValueError(f"{len(noise)} noise laws for {len(perturbations)} perturbation laws")
    laws = [initial, *noise, *perturbations]
    laws = [(np.asarray(atoms, dtype=float), np.asarray(weights, dtype=float)) for atoms, weights in laws]
    for atoms, weights in laws:
        if weights.shape != atoms.shape[:1] or np.any(weights < 0) or abs(weights.sum() - 1) > 1e-12:
            raise ValueError("a law needs one non-negative probability an atom, with sum 1")
    sizes = [weights.size for _, weights in laws]
    choice = np.unravel_index(np.arange(np.prod(sizes)), sizes)  # choice[l][p]: the atom of law l on path p
    probability = np.ones(choice[0].size)
    for (_, weights), index in zip(laws, choice, strict=True):
        probability = probability * weights[index]
    drawn = [atoms[index] for (atoms, _), index in zip(laws, choice, strict=True)]
    horizon = len(noise)
    return Paths(
        probability,
        drawn[0],
        np.stack(drawn[1 : horizon + 1], axis=1),
        np.stack(drawn[horizon + 1 :], axis=1),
    )


def simulate(A, B, K, M, paths: Paths) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States, inputs and their derivatives with respect to M, on every path.

    Args:
        A: (T, n, n). B: (T, n, m). K: (T + 1, m, n). M: (H, m, n).
        paths: the joint outcomes.

    Returns:
        x (p, T + 1, n), u (p, T + 1, m), dx (p, T + 1, n, H, m, n) with
        dx[p, t, a, i, b, c] = d x_t[a] / d M[i, b, c] on path p, and du (p, T + 1, m, H, m, n) alike.
    """
    A, B, K, M = (np.asarray(value, dtype=float) for value in (A, B, K, M))
    horizon, n, m = B.shape
    memory = M.shape[0]
    count = paths.probability.size
    on_input = paths.perturbation.shape[-1] == n + m
    identity = np.eye(m)

    x = np.zeros((count, horizon + 1, n))
    u = np.zeros((count, horizon + 1, m))
    dx = np.zeros((count, horizon + 1, n, memory, m, n))
    du = np.zeros((count, horizon + 1, m, memory, m, n))
    x[:, 0] = paths.initial_state
    for t in range(horizon + 1):
        u[:, t] = -x[:, t] @ K[t].T
        du[:, t] = -np.einsum("ba,pa...->pb...", K[t], dx[:, t])
        for i in range(1, memory + 1):
            if t - i >= 0:
                past = paths.noise[:, t - i]
                u[:, t] += past @ M[i - 1].T
                du[:, t, :, i - 1] += np.einsum("de,pc->pdec", identity, past)  # d (M w)[d] / d M[e, c]
        if t == horizon:
            break
        delta = paths.perturbation[:, t]
        z, dz = x[:, t], dx[:, t]
        if on_input:
            z, dz = np.concatenate([z, u[:, t]], axis=1), np.concatenate([dz, du[:, t]], axis=1)
        x[:, t + 1] = x[:, t] @ A[t].T + u[:, t] @ B[t].T + np.einsum("pab,pb->pa", delta, z) + paths.noise[:, t]
        dx[:, t + 1] = (
            np.einsum("ab,pb...->pa...", A[t], dx[:, t])
            + np.einsum("ab,pb...->pa...", B[t], du[:, t])
            + np.einsum("pab,pb...->pa...", delta, dz)
        )
    return x, u, dx, du


def stage_gradients(x, u, Q, R, cross=None, state_target=None, input_target=None):
    """Stage costs and their gradients with respect to the state and the input, on every path.

    Args:
        x: (p, T + 1, n). u: (p, T + 1, m). Q: (T + 1, n, n). R: (T + 1, m, m), neither need be symmetric.
        cross: N (T + 1, n, m), or None for zero.
        state_target: (T + 1, n), or None for zero. input_target: (T + 1, m), or None for zero.

    Returns:
        cost (p, T + 1), gradient in x (p, T + 1, n), gradient in u (p, T + 1, m).
    """
    Q, R = np.asarray(Q, dtype=float), np.asarray(R, dtype=float)
    N = np.zeros((Q.shape[0], Q.shape[1], R.shape[1])) if cross is None else np.asarray(cross, dtype=float)
    x = x if state_target is None else x - state_target
    u = u if input_target is None else u - input_target
    cost = (
        np.einsum("pta,tab,ptb->pt", x, Q, x)
        + np.einsum("pta,tab,ptb->pt", u, R, u)
        + 2 * np.einsum("pta,tab,ptb->pt", x, N, u)
    )
    grad_x = np.einsum("tab,ptb->pta", Q + Q.swapaxes(1, 2), x) + 2 * np.einsum("tab,ptb->pta", N, u)
    grad_u = np.einsum("tab,ptb->pta", R + R.swapaxes(1, 2), u) + 2 * np.einsum("tba,ptb->pta", N, x)
    return cost, grad_x, grad_u


def enumerate_cost(
    A, B, K, Q, R, M, noise, perturbations, initial, cross=None, state_target=None, input_target=None
) -> tuple[float, np.ndarray]:
    """The expected total cost and its gradient with respect to M, the law of the perturbations held fixed.

    Args:
        A: (T, n, n). B: (T, n, m). K: (T + 1, m, n). Q: (T + 1, n, n). R: (T + 1, m, m). M: (H, m, n).
        noise: for each t the atoms (k, n) of w_t and their probabilities (k,).
        perturbations: for each t the atoms (j, n, n) or (j, n, n + m) of Delta_t and their
            probabilities (j,).
        initial: the atoms (l, n) of x_0 and their probabilities (l,).
        cross: N (T + 1, n, m), or None for zero.
        state_target: (T + 1, n), or None for zero. input_target: (T + 1, m), or None for zero.

    Returns:
        The cost, and the gradient (H, m, n).
    """
    paths = enumerate_paths(noise, perturbations, initial)
    x, u, dx, du = simulate(A, B, K, M, paths)
    cost, grad_x, grad_u = stage_gradients(x, u, Q, R, cross, state_target, input_target)
    gradient = np.einsum("p,pta,ptaibc->ibc", paths.probability, grad_x, dx, optimize=True) + np.einsum(
        "p,pta,ptaibc->ibc", paths.probability, grad_u, du, optimize=True
    )
    return float(paths.probability @ cost.sum(axis=1)), gradient
