"""Exact mean-square error of greedy stochastic gradient descent in scalar performative mean estimation.

The data z react to the deployed decision, z = mean + sensitivity * decision + deviation * (zero mean, unit
variance), and the loss is (z - decision)^2 / 2. In the control problem: x_0 = 0, A = 0, K = 0, B = -1 and
w = 1 give x_1 = 1 and x_2 = Delta_1 - M + 1, so z = 1 + Delta_1, and the only cost is x_2^2 / 2
(T = 2, H = 1).

With s the sensitivity, the mean gradient theta - mean - s theta vanishes at theta* = mean / (1 - s).
A step theta - eta (theta - z) with a fresh z turns the error e = theta - theta* into
(1 - eta (1 - s)) e + eta * deviation * (zero mean, unit variance, independent of e), and so

    E e_{t+1}^2 = (1 - eta_t (1 - s))^2 E e_t^2 + eta_t^2 deviation^2
"""

from collections.abc import Iterable

import numpy as np


def stable_decision(mean: float, sensitivity: float) -> float:
    """The performatively stable decision, mean / (1 - sensitivity)."""
    return mean / (1 - sensitivity)


def squared_errors(
    step_sizes: Iterable[float], initial: float, mean: float, sensitivity: float, deviation: float
) -> np.ndarray:
    """E (theta_t - theta*)^2 for t = 0..N after t greedy steps; (N + 1,) for N step sizes.

    Args:
        step_sizes: eta of the first, second, ... step.
        initial: theta_0.
        mean, sensitivity, deviation: of the data, as in the module's heading.
    """
    errors = [(initial - stable_decision(mean, sensitivity)) ** 2]
    for step in step_sizes:
        errors.append((1 - step * (1 - sensitivity)) ** 2 * errors[-1] + step**2 * deviation**2)
    return np.array(errors)


def published_step_size(
    t: int, sensitivity: float, convexity: float = 1.0, smoothness: float = 1.0, lipschitz: float = 1.0
) -> float:
    """1 / ((gamma - eps beta) t + 8 L^2 / (gamma - eps beta)) for t = 1, 2, ..., the first step having t = 1.

    Args:
        t: the number of the step, from 1.
        sensitivity: eps. convexity: gamma. smoothness: beta. lipschitz: L.
    """
    margin = convexity - sensitivity * smoothness
    return 1 / (margin * t + 8 * lipschitz**2 / margin)
