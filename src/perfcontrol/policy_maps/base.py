"""The interface of a policy map: how a quantity depends on the policy, and what is known of it over a set.

Most maps give an array; one that says how the noise reacts gives the law of a random vector. Families and theory ask
a map what it knows, whatever its kind; None always means "not known". Sets are sets of lifted policies (`LiftedSet`).
"""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array


class AbstractPolicyMap(eqx.Module):
    """M -> an array (or a law, for noise), where M is the lifted policy (memory, input, state)."""

    @abc.abstractmethod
    def __call__(self, M: Array) -> Any:
        """The value at the policy M."""

    def range(self, feasible_set: Any) -> tuple[Array, Array] | None:
        """Numbers that the entries stay between over the set: low and high, each of the value's shape."""
        return None

    def lipschitz(self, feasible_set: Any) -> Array | None:
        """Lipschitz constants of the entries over the set, per unit of ‖M - M'‖_F; of the value's shape."""
        return None

    def largest(self, feasible_set: Any) -> Array | None:
        """A bound of |entries| over the set."""
        bounds = self.range(feasible_set)
        return None if bounds is None else jnp.maximum(jnp.abs(bounds[0]), jnp.abs(bounds[1]))

    def matrix_bound(self, feasible_set: Any) -> Array | None:
        """A bound over the set of the spectral norm of a matrix-valued map, () or (T,)."""
        # Entry by entry only the Frobenius norm is monotone.
        entries = self.largest(feasible_set)
        return None if entries is None else jnp.linalg.norm(entries, axis=(-2, -1))

    def matrix_lipschitz(self, feasible_set: Any, weights: Any = 1.0) -> Array | None:
        """A Lipschitz constant in Frobenius norm of a matrix-valued map times weights (n, p), () or (T,)."""
        entries = self.lipschitz(feasible_set)
        return None if entries is None else jnp.linalg.norm(weights * entries, axis=(-2, -1))

    def derivative(self) -> Array | None:
        """The derivative by M where it is the same at every policy, of shape value.shape + (memory, input, state)."""
        return None

    @property
    def constant(self) -> bool:
        """Whether the value is known to be the same for every policy, whatever the set."""
        return False

    @property
    def continuous(self) -> bool | None:
        """True where the value is proved to be continuous in M."""
        return None

    @property
    def convex(self) -> bool | None:
        """Whether {M : |entry| ≤ s} is convex for every entry and every s."""
        return None
