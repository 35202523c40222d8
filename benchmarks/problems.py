"""What is measured: stable closed loops of some shape and kind."""

import jax
import jax.numpy as jnp
import numpy as np

import perfcontrol as pc

SHAPES = {"(20, 1, 60)": (20, 1, 60), "(4, 10, 200)": (4, 10, 200), "(100, 5, 100)": (100, 5, 100)}  # n = m, H, T


def problem_of(n: int, H: int, T: int, kind: str = "dense", law: str = "rademacher") -> pc.PerformativeProblem:
    """A stable closed loop with dense or directional perturbations that react to the policy."""
    r = np.random.default_rng(n + T)
    A = r.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    if kind == "dense":
        perturbation = pc.DensePerturbation(lambda M: 0.1 / n * jnp.sqrt(1 + jnp.sum(M**2) / n), law=law)
    else:
        directions = r.standard_normal((2, n, n)) / n
        perturbation = pc.DirectionalPerturbation(
            directions, lambda M: 0.1 * jnp.sqrt(1 + jnp.sum(M**2) / n) * jnp.ones(2)
        )
    return pc.PerformativeProblem(
        system=pc.LinearSystem(A, r.standard_normal((n, n)) / np.sqrt(n)),
        horizon=T,
        memory=H,
        gain=0.01 * r.standard_normal((n, n)),
        noise=pc.Rademacher(np.ones(n)),
        cost=pc.QuadraticCost(np.eye(n), 0.1 * np.eye(n)),
        perturbation=perturbation,
    )


def policy_of(problem: pc.PerformativeProblem) -> jax.Array:
    raw = 0.05 * jax.random.normal(jax.random.key(0), problem.policy_shape, problem.dtype)
    return problem.feasible_set.project(raw)
