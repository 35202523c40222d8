"""Exact expected cost from the second moment of one extended state, dense, with no recursion of blocks.

With s_t = [x_t; w_{t-1}; ...; w_{t-H}; 1] the policy, the perturbed vector z_t and the deviations from the
targets are all linear in s_t, and s_{t+1} = Phi_t s_t + J (w_t - E w_t) + I_x (Delta_t - Theta_t) z_t. As
w_t and Delta_t are independent of s_t and of each other,

    E s_{t+1} s_{t+1}' = Phi_t S_t Phi_t' + J Cov(w_t) J'
                         + I_x E[(Delta_t - Theta_t) Z_t (Delta_t - Theta_t)'] I_x'

with S_t = E s_t s_t' and Z_t = E z_t z_t'. The constant last entry carries every mean.
"""

from collections.abc import Callable

import numpy as np


def expected_cost_moments(
    A,
    B,
    K,
    Q,
    R,
    M,
    noise_mean,
    noise_covariance,
    perturbation_mean,
    covariance_apply: Callable[[int, np.ndarray], np.ndarray],
    initial_mean,
    initial_covariance,
    cross=None,
    state_target=None,
    input_target=None,
    number: type = float,
) -> float:
    """The expected total cost, terminal stage included, from the first two moments of what is random.

    Args:
        A: (T, n, n). B: (T, n, m). K: (T + 1, m, n). Q: (T + 1, n, n). R: (T + 1, m, m). M: (H, m, n).
        noise_mean: (T, n). noise_covariance: (T, n, n), about the mean.
        perturbation_mean: Theta, (T, n, n), or (T, n, n + m) where the perturbations act on [x; u].
        covariance_apply: maps t and a symmetric matrix X of the size of z to
            E[(Delta_t - Theta_t) X (Delta_t - Theta_t)'], (n, n).
        initial_mean: (n,). initial_covariance: (n, n), about the mean.
        cross: N (T + 1, n, m), or None for zero.
        state_target: (T + 1, n), or None for zero. input_target: (T + 1, m), or None for zero.
        number: object where the entries are numbers of Python, such as fractions, which do not round.
    """
    A, B, K, Q, R, M, Theta = (np.asarray(value, dtype=number) for value in (A, B, K, Q, R, M, perturbation_mean))
    horizon, n, m = B.shape
    memory = M.shape[0]
    N = np.zeros((horizon + 1, n, m), dtype=number) if cross is None else np.asarray(cross, dtype=number)
    xs = np.zeros((horizon + 1, n), dtype=number) if state_target is None else np.asarray(state_target, dtype=number)
    us = np.zeros((horizon + 1, m), dtype=number) if input_target is None else np.asarray(input_target, dtype=number)
    size = n + memory * n + 1

    def lag(i: int) -> slice:
        """Where w_{t-i} lies in s_t."""
        return slice(n * i, n * (i + 1))

    select_state = np.zeros((n, size), dtype=number)
    select_state[:, :n] = np.eye(n, dtype=number)
    constant = np.zeros(size, dtype=number)
    constant[-1] = 1
    inject = np.zeros((size, n), dtype=number)  # how w_t enters s_{t+1}: in the state and as the newest lag
    inject[:n] = np.eye(n, dtype=number)
    inject[lag(1)] = np.eye(n, dtype=number)

    start = np.concatenate([np.asarray(initial_mean, dtype=number), np.zeros(memory * n, dtype=number), [1]])
    S = np.outer(start, start)
    S[:n, :n] += initial_covariance

    total = 0
    for t in range(horizon + 1):
        select_input = -K[t] @ select_state
        for i in range(1, memory + 1):
            select_input[:, lag(i)] += M[i - 1]

        deviation = np.concatenate([select_state - np.outer(xs[t], constant), select_input - np.outer(us[t], constant)])
        weight = np.block([[Q[t], N[t]], [N[t].T, R[t]]])
        total += np.trace(weight @ deviation @ S @ deviation.T)
        if t == horizon:
            break

        if Theta.shape[-1] == n + m:
            select_perturbed = np.concatenate([select_state, select_input])
        else:
            select_perturbed = select_state
        transition = np.zeros((size, size), dtype=number)
        transition[:n] = A[t] @ select_state + B[t] @ select_input + Theta[t] @ select_perturbed
        for i in range(1, memory):
            transition[lag(i + 1), lag(i)] = np.eye(n, dtype=number)
        transition[-1, -1] = 1
        transition += np.outer(inject @ noise_mean[t], constant)

        spread = covariance_apply(t, select_perturbed @ S @ select_perturbed.T)
        S = (
            transition @ S @ transition.T
            + inject @ noise_covariance[t] @ inject.T
            + select_state.T @ spread @ select_state
        )
    return total if number is object else float(total)
