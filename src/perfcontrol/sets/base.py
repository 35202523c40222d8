"""The interface of a feasible set: a closed convex set of policies (memory, input, state)."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from perfcontrol.sets.structures import AbstractStructure


class AbstractSet(eqx.Module):
    """A closed convex set with its Euclidean (Frobenius) projection."""

    @abc.abstractmethod
    def project(self, M: Array) -> Array:
        """The nearest point of the set."""

    @abc.abstractmethod
    def support(self, direction: Array) -> Array | None:
        """sup <direction, M> over the set, for directions with any leading axes; None where it may be infinite."""

    @property
    def affine(self) -> bool:
        """Whether the set is an affine subspace: then its projection is affine, and best responses are solves."""
        return False

    def radius(self, shape: tuple[int, ...]) -> Array | None:
        """sup ‖M‖_F over the set, for policies of that shape; None if unbounded."""
        return None

    def farthest(self, center: Array) -> Array | None:
        """sup ‖M - center‖_F over the set, or a bound of it; None if unbounded."""
        radius = self.radius(center.shape)
        return None if radius is None else radius + jnp.linalg.norm(center.reshape(-1))

    def distance(self, center: Array) -> Array:
        """inf ‖M - center‖_F over the set, or a bound of it."""
        return jnp.linalg.norm((center - self.project(center)).reshape(-1))

    @property
    def row_total(self) -> Array | None:
        """The sum of every row where the set fixes it, else None."""
        return None

    @property
    def nonnegative(self) -> bool:
        """Whether all entries are known to be nonnegative."""
        return False

    def check(self, shape: tuple[int, ...]) -> None:
        """Raise InputError where the set does not fit free parameters of that shape."""

    def contains(self, M: Array, tolerance: float = 1e-8) -> Array:
        """Whether M lies in the set up to `tolerance` relative to its norm."""
        return jnp.linalg.norm(M - self.project(M)) <= tolerance * jnp.maximum(1, jnp.linalg.norm(M))


class LiftedSet(eqx.Module):
    """The image of a set of free parameters under a structure, as perturbation laws see it."""

    inner: AbstractSet
    structure: AbstractStructure
    shape: tuple[int, int, int] = eqx.field(static=True)  # of the lifted policy

    def support(self, direction: Array) -> Array | None:
        flat = direction.reshape(-1, *direction.shape[-3:])
        values = self.inner.support(jax.vmap(self.structure.adjoint)(flat))
        return None if values is None else values.reshape(direction.shape[:-3])

    @property
    def radius(self) -> Array | None:
        """sup ‖M‖_F of the lifted policies (an upper bound under a structure)."""
        inner = self.inner.radius(self.structure.free_shape(self.shape))
        return None if inner is None else self.structure.norm * inner

    def farthest(self, center: Array) -> Array | None:
        """sup ‖M - center‖_F, or a bound of it; None if unbounded."""
        free, outside = self._split(center)
        inner = self.inner.farthest(free)
        return None if inner is None else jnp.hypot(self.structure.norm * inner, outside)

    def distance(self, center: Array) -> Array:
        """inf ‖M - center‖_F, or a bound of it."""
        free, outside = self._split(center)
        return jnp.hypot(self.structure.norm * self.inner.distance(free), outside)

    def _split(self, center: Array) -> tuple[Array, Array]:
        """The free parameters nearest to a policy, and the length of what lies outside the structure."""
        free = self.structure.adjoint(center) / self.structure.norm**2
        return free, jnp.linalg.norm((center - self.structure.lift(free)).reshape(-1))

    @property
    def row_total(self) -> Array | None:
        return self.inner.row_total

    @property
    def nonnegative(self) -> bool:
        return self.inner.nonnegative

    @property
    def policy_size(self) -> int:
        """Columns n of the lifted policy."""
        return self.shape[-1]

    @property
    def free_columns(self) -> int:
        """Columns of the free parameters, whose rows `row_total` and `nonnegative` speak of."""
        return self.structure.free_shape(self.shape)[-1]
