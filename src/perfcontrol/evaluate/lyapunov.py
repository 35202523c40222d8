"""X = W + 𝒯(X) for an operator that keeps positive semidefinite matrices positive semidefinite, and whether it has one.

Symmetric matrices have n(n+1)/2 free entries: few of them make one linear system, many the Neumann series Σ 𝒯ᵏ(W).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

DENSE = 24  # n up to which the system is held as a matrix
SERIES = 50_000  # terms of the series at most

Operator = Callable[[Array], Array]


def solve_fixed_point(operator: Operator, right: Float[Array, "k n n"]) -> Float[Array, "k n n"]:
    """The solutions for several symmetric right-hand sides; whether ρ(𝒯) < 1 is for `is_stable` to say."""
    n = right.shape[-1]
    if n > DENSE:
        return _by_series(jax.vmap(operator), right)
    matrix = _matrix(operator, n, right.dtype)
    rows, columns = np.triu_indices(n)
    entries = jnp.linalg.solve(jnp.eye(len(rows), dtype=right.dtype) - matrix, right[:, rows, columns].T).T
    return jnp.zeros_like(right).at[:, rows, columns].set(entries).at[:, columns, rows].set(entries)


def is_stable(from_identity: Float[Array, "n n"]) -> Array:
    """Whether ρ(𝒯) < 1, given the solution X of X = I + 𝒯(X).

    If X ⪰ 0 then X ⪰ I and 𝒯(X) = X - I ⪯ (1 - 1/λ_max(X)) X, so that ρ(𝒯) ≤ 1 - 1/λ_max(X); and ρ(𝒯) < 1 gives
    X = Σ 𝒯ᵏ(I) ⪰ I.
    """
    X = jax.lax.stop_gradient(from_identity)
    finite = jnp.all(jnp.isfinite(X))
    values = jnp.linalg.eigvalsh(jnp.where(finite, X, 0))
    return finite & (values[0] > 0.5) & (values[-1] * jnp.finfo(X.dtype).eps < 0.01)


def spectral_radius(operator: Operator, size: int, dtype: Any) -> Array:
    """ρ(𝒯) by the growth of 𝒯ᵏ(I), of which ρ(𝒯)ᵏ is the rate: I is inside the cone that 𝒯 keeps."""
    rounds = 1000

    def grow(k: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        X, total = carry
        X = operator(X)
        growth = jnp.linalg.norm(X)
        counted = jnp.where(k >= rounds // 2, jnp.log(growth), 0)  # what the start adds has gone by then
        return X / jnp.where(growth > 0, growth, 1), total + counted

    eye = jnp.eye(size, dtype=dtype)
    _, total = jax.lax.fori_loop(0, rounds, grow, (eye, jnp.zeros((), dtype)))
    return jnp.exp(total / (rounds - rounds // 2))


def _matrix(operator: Operator, n: int, dtype: Any) -> Array:
    """𝒯 on the entries (i, j), i ≤ j, of a symmetric matrix."""
    rows, columns = np.triu_indices(n)
    basis = np.zeros((len(rows), n, n))
    index = np.arange(len(rows))
    basis[index, rows, columns] = basis[index, columns, rows] = 1
    return jax.vmap(operator)(jnp.asarray(basis, dtype))[:, rows, columns].T


def _by_series(operator: Operator, right: Array) -> Array:
    """The same by adding up residuals; not finite where they do not fade."""
    eps = float(jnp.finfo(right.dtype).eps)

    def solve(matvec: Operator, b: Array) -> Array:
        largest = jnp.linalg.norm(b) / eps

        def unfinished(carry: Any) -> Array:
            X, rest, count = carry
            size = jnp.linalg.norm(X)
            return (jnp.linalg.norm(rest) > 20 * eps * size) & (size <= largest) & (count < SERIES)

        def add(carry: Any) -> Any:
            X, rest, count = carry
            X = X + rest
            return X, b - matvec(X), count + 1

        X, rest, _ = jax.lax.while_loop(unfinished, add, (jnp.zeros_like(b), b, jnp.asarray(0)))
        return jnp.where(jnp.linalg.norm(rest) <= 20 * eps * jnp.linalg.norm(X), X, jnp.nan)

    return jax.lax.custom_linear_solve(lambda X: X - operator(X), right, solve, transpose_solve=solve)
