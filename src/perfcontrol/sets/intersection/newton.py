"""Newton steps on the fixed-point equations of a projection."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._linalg import symmetrise, transpose
from perfcontrol.sets.base import AbstractSet
from perfcontrol.sets.intersection.dykstra import Sets, Split, projections, split_at

LENGTHS = (1.0, 0.5, 0.25, 0.1, 0.03)  # of Newton steps


class Linearised:
    """The equations dx = J_i (dx + dp_i) + e_i, dx + Σ dp_i = dy, J_i the derivative of P_i at x + p_i.

    Along the null space of J_i they fix dx; across them dp_i = J_i⁺ (dx - e_i) - Π_i dx with Π_i = J_i⁺ J_i.
    """

    def __init__(self, sets: Sets, split: Split, shape: tuple[int, ...]):
        negligible = float(jnp.finfo(split.x.dtype).eps) ** 0.75
        eye = jnp.eye(split.x.size, dtype=split.x.dtype)
        slopes = []
        for member, part in zip(sets, split.parts, strict=True):

            def flat(z: Array, member: AbstractSet = member) -> Array:
                return member.project(z.reshape(shape)).reshape(-1)

            slopes.append(jax.jacfwd(flat)(split.x + part))
        values, vectors = jnp.linalg.eigh(symmetrise(jnp.stack(slopes)))
        kept = (values > negligible)[:, None, :]
        # What stands along the null spaces does not matter: `free` takes it out of every product.
        self.inverses = (vectors / jnp.where(kept, values[:, None, :], 1)) @ transpose(vectors)
        self.normals = (vectors * ~kept) @ transpose(vectors)
        values, vectors = jnp.linalg.eigh(jnp.sum(self.normals, axis=0))
        fixed = values > 10 * negligible
        self.held = (vectors * jnp.where(fixed, 1 / jnp.where(fixed, values, 1), 0)) @ vectors.T
        self.free = (vectors * ~fixed) @ vectors.T
        self.metric = eye + jnp.sum(self.inverses + self.normals - eye, axis=0)
        self.system = jax.scipy.linalg.cho_factor(self.free @ self.metric @ self.free + eye - self.free)

    def move(self, errors: Float[Array, "k p"], dy: Float[Array, " p"]) -> Array:
        """dx."""
        held = self.held @ jnp.einsum("kab,kb->a", self.normals, errors)
        right = dy + jnp.einsum("kab,kb->a", self.inverses, errors) - self.metric @ held
        return held + self.free @ jax.scipy.linalg.cho_solve(self.system, self.free @ right)

    def parts(self, errors: Float[Array, "k p"], dx: Array, dy: Array) -> Float[Array, "k p"]:
        """dp_i, the undetermined components shared out evenly."""
        moved = jnp.einsum("kab,kb->ka", self.inverses, dx - errors) - (dx - self.normals @ dx)
        rest = self.held @ (dy - dx - jnp.sum(moved, axis=0))
        return moved + self.normals @ rest


def newton_step(sets: Sets, split: Split, shape: tuple[int, ...]) -> Split:
    """The best of the splits along Newton's direction; its defect is NaN where all fail."""
    zero = jnp.zeros_like(split.x)
    linear = Linearised(sets, split, shape)
    errors = projections(sets, split.x + split.parts, shape) - split.x
    dx = linear.move(errors, zero)
    dparts = linear.parts(errors, dx, zero)
    lengths = jnp.asarray(LENGTHS, split.x.dtype)
    tried = jax.vmap(lambda t: split_at(sets, split.x + t * dx, split.parts + t * dparts, shape))(lengths)
    return jax.tree.map(lambda leaf: leaf[jnp.nanargmin(tried.defect)], tried)
