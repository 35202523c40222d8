"""A problem with an infinite horizon and every part that one may have, shared by tests of the long run."""

import math

import jax.numpy as jnp

import perfcontrol as pc
from tests.tools import normal, random_psd

n, m, H = 3, 2, 3
A, B, K = 0.25 * normal(1, n, n), 0.7 * normal(2, n, m), 0.1 * normal(3, m, n)
D = 0.15 * normal(4, 2, n, n + m)
Q, R, CROSS = random_psd(5, n), random_psd(6, m), 0.05 * normal(7, n, m)
X_TARGET, U_TARGET = normal(8, n), normal(9, m)
W_MEAN, W_COVARIANCE = 0.4 * normal(10, n), random_psd(11, n)
OFFSET = 0.03 * normal(12, n, n + m)
M, DEPLOYED = 0.2 * normal(13, H, m, n), 0.2 * normal(14, H, m, n)


def scales(M):
    return jnp.stack([0.3 + 0.2 * jnp.sum(M**2), 0.2 + 0.1 * jnp.sum(M)])


def offset(M):
    return OFFSET * (1 + jnp.sum(M))


def everything(horizon=math.inf, mean=W_MEAN, **others) -> pc.PerformativeProblem:
    """Targets, a cross weight, a noise mean, a gain, and a reacting Δ of reacting mean on [x; u]."""
    parts = {
        "system": pc.LinearSystem(A, B),
        "noise": pc.Gaussian(mean, W_COVARIANCE),
        "cost": pc.QuadraticCost(Q, R, cross=CROSS, state_target=X_TARGET, input_target=U_TARGET),
        "memory": H,
        "gain": K,
        "perturbation": pc.DirectionalPerturbation(D, pc.Function(scales), mean=pc.Function(offset)),
    }
    return pc.PerformativeProblem(horizon=horizon, **{**parts, **others})
