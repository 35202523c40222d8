"""How the gradient moves with the deployed policy: 𝐄 = ∂_2 ∇_1 C_T, as a matrix."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol._programs import program
from perfcontrol.evaluate.exact import exact_gradient
from perfcontrol.problem import PerformativeProblem


@program
def reaction_jacobian(problem: PerformativeProblem, M: Any, deployed: Any) -> Array:
    """𝐄 at (M, deployed) in the free parameters, (p, p): column j is the derivative by the deployed parameter j."""
    _, push = jax.linearize(lambda policy: exact_gradient(problem, M, policy), deployed)
    eye = jnp.eye(M.size, dtype=M.dtype).reshape(M.size, *M.shape)
    return jax.lax.map(push, eye, batch_size=min(16, M.size)).reshape(M.size, M.size).T
