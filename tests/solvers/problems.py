"""Small problems whose stable policies are known, shared by the tests of the solvers."""

import jax.numpy as jnp
import numpy as np

import perfcontrol as pc
from tests.tools import normal

MEAN, DEVIATION = 10.0, 0.1


def performative_prediction(sensitivity, mean=MEAN, deviation=DEVIATION, feasible_set=None) -> pc.PerformativeProblem:
    """Scalar performative mean estimation (maths: section 7): Φ(M) = mean + sensitivity M."""
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.0]], [[-1.0]]),
        horizon=2,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost(np.array([0.0, 0.0, 0.5])[:, None, None], [[0.0]]),
        perturbation=pc.DirectionalPerturbation(
            [[[1.0]]], jnp.asarray([deviation]), mean=pc.Affine([[mean - 1]], [[[[[sensitivity]]]]])
        ),
        feasible_set=feasible_set,
    )


def _switched_scale(M, params):
    """Standard deviation between √low and √high, depending on one statistic of the policy."""
    statistic = jnp.sum(params["direction"] * M) - params["centre"]
    variance = params["low"] + (params["high"] - params["low"]) * (1 + jnp.tanh(params["slope"] * statistic)) / 2
    return jnp.sqrt(variance)[None]


def _switched(seed, direction, centre, slope, low, high, mean=0.0, covariance=None, feasible_set=None):
    """Three states, two inputs, two lags, a gain. All problems made here share what is compiled for them."""
    params = {"direction": direction, "centre": centre, "slope": slope, "low": low, "high": high}
    return pc.PerformativeProblem(
        system=pc.LinearSystem(0.4 * normal(seed + 2, 3, 3), 0.5 * normal(seed + 3, 3, 2)),
        horizon=6,
        noise=pc.Gaussian(jnp.broadcast_to(mean, 3), np.diag([1.0, 0.5, 2.0]) if covariance is None else covariance),
        cost=pc.QuadraticCost(np.eye(3), np.eye(2)),
        memory=2,
        gain=0.05 * normal(seed + 4, 2, 3),
        perturbation=pc.DirectionalPerturbation(normal(seed + 5, 1, 3, 3), pc.Function(_switched_scale, params)),
        feasible_set=feasible_set,
        initial_state=[1.0, 0.0, -1.0],
    )


def drifting(seed: int = 0, feasible_set=None, mean=0.1, covariance=None) -> pc.PerformativeProblem:
    """Mildly performative: repeated minimisation contracts."""
    return _switched(seed, normal(seed + 1, 2, 2, 3), 0.1, 0.5, 0.01, 0.1, mean, covariance, feasible_set)


def strongly_performative(slope: float = 8.0) -> pc.PerformativeProblem:
    """One stable policy, at which the derivative of Φ has an eigenvalue far below -1.

    The world is calm where the policy is that of a turbulent one and turbulent where it is that of a calm one, so
    repeated minimisation jumps between the two; the statistic of Φ decreases in its own, so it crosses once.
    """
    nowhere = jnp.zeros((2, 2, 3))
    calm, turbulent = (pc.best_response(_switched(0, nowhere, side, 50.0, 0.05, 2.0), nowhere) for side in (1.0, -1.0))
    direction = (calm - turbulent) / jnp.sum((calm - turbulent) ** 2)  # 1 apart in the statistic
    return _switched(0, direction, jnp.sum(direction * (calm + turbulent)) / 2, slope, 0.05, 2.0)


def swapped(rho: float, back: float | None = None) -> pc.PerformativeProblem:
    """Static: z = rho P M + signs with P the swap of two coordinates, cost ½‖z - M‖²; M is the policy's column 0.

    The average of N iterates has covariance (I - rho P)⁻² / N around the stable policy 0 (maths: section 12). With
    `back` the second coordinate reacts to the first by that factor instead.
    """
    first = np.outer([1.0, 0.0], [1.0, 0.0])
    weight = np.zeros((2, 2, 1, 2, 2))
    weight[0, 0, 0, 1, 0], weight[1, 0, 0, 0, 0] = rho, rho if back is None else back
    return pc.PerformativeProblem(
        system=pc.LinearSystem(np.zeros((2, 2)), -np.eye(2)),
        horizon=2,
        noise=pc.Constant([1.0, 0.0]),
        cost=pc.QuadraticCost(np.array([0.0, 0.0, 0.5])[:, None, None] * np.eye(2), np.zeros((2, 2))),
        perturbation=pc.DirectionalPerturbation(
            np.stack([first, first[::-1]]), np.ones(2), mean=pc.Affine(-first, weight)
        ),
        feasible_set=pc.Support(np.array([[True, False], [True, False]])),
    )


def steered() -> pc.PerformativeProblem:
    """Two states, one input, two parameters; scale and mean of the perturbation react."""
    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.6, 0.3], [0.0, 0.5]], [[0.0], [1.0]]),
        horizon=4,
        noise=pc.Rademacher([1.0, 0.5]),
        cost=pc.QuadraticCost(np.eye(2), [[0.2]]),
        gain=[[0.1, 0.2]],
        perturbation=pc.DirectionalPerturbation(
            [[[0.0, 0.0], [0.3, 0.2]]],
            pc.Affine([0.5], [[[[0.5, 0.3]]]]),
            mean=pc.Affine(np.zeros((2, 2)), 0.3 * normal(0, 2, 2, 1, 1, 2)),
        ),
    )


def overflowing() -> pc.PerformativeProblem:
    """The world of any policy but a tiny one is not finite."""

    def scale(M, params):
        return jnp.where(jnp.sum(M**2) > params["limit"], jnp.inf, 0.1)[None]

    return pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5]], [[1.0]]),
        horizon=4,
        noise=pc.Uniform([-1.0], [1.0]),
        cost=pc.QuadraticCost([[1.0]], [[1.0]]),
        perturbation=pc.DirectionalPerturbation([[[1.0]]], pc.Function(scale, {"limit": 1e-3})),
    )
