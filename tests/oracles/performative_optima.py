"""Published families of performative prediction with closed forms, as control problems: stable and optimal decision.

The decision is the policy's one free number theta; z is what the world answers, by the perturbation Delta.

- location, z = mu + e theta + noise, loss (z - theta)^2 / 2 + r theta^2 / 2 (Perdomo et al. 2020, with a penalty):
  PS (mu + e theta - theta = r theta): mu / (1 - e + r);  PO: (1 - e) mu / ((1 - e)^2 + r).
- scale, z = mu + s theta' noise, same loss without penalty: PS mu (the spread is not the decision's fault), PO
  mu / (1 + s^2).
- pricing, demand z = mu - e theta', revenue theta z: PS mu / e (demand at zero: every price earns the same), PO
  mu / (2 e) (Miller, Perdomo and Zrnic 2021; Izzo, Ying and Zou 2021).
- linear, in two dimensions: loss |mu + E theta' - theta|^2 / 2 + r |theta|^2 / 2: PS ((1 + r) I - E)^-1 mu, PO the
  minimum of the quadratic by the normal equations with J = I - E: (J'J + r I)^-1 J' mu.
"""

import numpy as np

import perfcontrol as pc

ONE = np.ones((1, 1))


def _perturbed(horizon: int, at: int, offset: float, slope: float, deviation, memory_shape=(1, 1, 1)):
    """Δ of mean offset + slope M at one time, zero elsewhere; `deviation` is a map or numbers (T, 1)."""
    offsets, slopes = np.zeros((horizon, 1, 1)), np.zeros((horizon, 1, 1, *memory_shape))
    offsets[at], slopes[at] = offset, slope
    return pc.DirectionalPerturbation([ONE], deviation, mean=pc.Affine(offsets, slopes))


def location(mean: float, sensitivity: float, penalty: float, deviation: float = 0.1):
    """The problem, the stable decision, the optimal one."""
    Q, R = np.zeros((3, 1, 1)), np.zeros((3, 1, 1))
    Q[2], R[1] = 0.5, penalty / 2
    problem = pc.PerformativeProblem(  # x_1 = 1, x_2 = Δ_1 + 1 - M
        system=pc.LinearSystem(0 * ONE, -ONE),
        horizon=2,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost(Q, R),
        perturbation=_perturbed(2, 1, mean - 1, sensitivity, np.array([[0.0], [deviation]])),
    )
    return (
        problem,
        mean / (1 - sensitivity + penalty),
        (1 - sensitivity) * mean / ((1 - sensitivity) ** 2 + penalty),
    )


def scale(mean: float, slope: float):
    """Likewise."""
    Q = np.zeros((3, 1, 1))
    Q[2] = 0.5
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0 * ONE, -ONE),
        horizon=2,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost(Q, 0 * ONE),
        perturbation=pc.DirectionalPerturbation(
            [ONE], pc.Affine([0.0], slope * np.ones((1, 1, 1, 1))), mean=(mean - 1) * ONE
        ),
    )
    return problem, mean, mean / (1 + slope**2)


def pricing(mean: float, sensitivity: float):
    """Likewise. x_2 = M, x_3 = 1 - M z; the cost (x_3 - 1 + s)^2 with s above all revenues falls as revenue grows."""
    top = 10 * mean**2 / (4 * sensitivity)
    Q = np.zeros((4, 1, 1))
    Q[3] = 1.0
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(-ONE, ONE),
        horizon=3,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost(Q, 0 * ONE, state_target=[1 - top]),
        perturbation=_perturbed(3, 2, -mean, sensitivity, np.zeros((3, 1))),
        feasible_set=pc.Box(0.0, 2 * mean / sensitivity),
    )
    return problem, mean / sensitivity, mean / (2 * sensitivity)


def linear(mean: np.ndarray, sensitivity: np.ndarray, penalty: float):
    """Likewise, the decision in the first column of M; the other meets no noise and is held at zero."""
    Q, R = np.zeros((3, 2, 2)), np.zeros((3, 2, 2))
    Q[2], R[1] = np.eye(2) / 2, penalty / 2 * np.eye(2)
    slope = np.zeros((2, 2, 2, 1, 2, 2))
    slope[1, :, 0, 0, :, 0] = sensitivity
    offset = np.zeros((2, 2, 2))
    offset[1, :, 0] = mean - [1.0, 0.0]
    problem = pc.PerformativeProblem(  # x_1 = (1, 0), x_2 = (first column of Δ_1) + (1, 0) - M (1, 0)
        system=pc.LinearSystem(np.zeros((2, 2)), -np.eye(2)),
        horizon=2,
        noise=pc.Constant([1.0, 0.0]),
        cost=pc.QuadraticCost(Q, R),
        perturbation=pc.DirectionalPerturbation([np.eye(2)], np.array([0.0]), mean=pc.Affine(offset, slope)),
        feasible_set=pc.Support([[True, False], [True, False]]),
    )
    J = np.eye(2) - sensitivity
    stable = np.linalg.solve((1 + penalty) * np.eye(2) - sensitivity, mean)
    return problem, stable, np.linalg.solve(J.T @ J + penalty * np.eye(2), J.T @ mean)
