"""White random matrices of which only two products are ever drawn: Z z on the way ahead, Zᵀ y on the way back.

A path meets each Δ_t = Θ_t + s_t Z_t twice: at the state, Z z, and in the adjoint, Zᵀ y. Let the entries of Z be
independent standard normal and ẑ = z/‖z‖. Then Z ẑ and Z (I - ẑ ẑᵀ) are independent, whatever y makes of the former:

    Z z = ‖z‖ g,    Zᵀ y = ẑ (gᵀ y) + ‖y‖ (I - ẑ ẑᵀ) h,    g ~ N(0, I_n), h ~ N(0, I_p) independent:

n + p numbers in place of n p, of exactly the joint law. On the Frobenius sphere of radius √(np), Z = √(np) G/‖G‖ with G
normal. Then ‖G‖² = ‖g‖² + ρ², ρ² chi-square with n(p-1) degrees of freedom and independent of g; given ρ the rest of G
is uniform on a sphere, and its product with ŷ is ρ h⊥/√(‖h⊥‖² + χ²), h⊥ = (I - ẑ ẑᵀ) h, with (n-1)(p-1) degrees.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from perfcontrol._linalg import matvec, rmatvec
from perfcontrol.perturbations.base import PathDraws, varying


class WhiteDraws(PathDraws):
    """Θ_t + s_t Z_t by its two products on one path.

    location: Θ, None for zero, with the axis T where it varies; ahead: g, scaled to the sphere where Z lives on one;
    back: h; rest: ρ and χ² for the sphere, None for normal entries.
    """

    location: Float[Array, "*T n p"] | None
    scale: Float[Array, " T"]
    ahead: Float[Array, "T n"]
    back: Float[Array, "T p"]
    rest: Float[Array, "T 2"] | None
    remembers: ClassVar[bool] = True

    @property
    def steps(self) -> Any:
        return varying(self.location), self.scale, self.ahead, self.back, self.rest

    def matvec_step(self, step: Any, z: Array) -> Array:
        location, scale, ahead, _, _ = step
        location = self.location if location is None else location
        product = scale * jnp.linalg.norm(z) * ahead
        return product if location is None else product + matvec(location, z)

    def rmatvec_along(self, step: Any, y: Array, z: Array | None) -> Array:
        location, scale, ahead, back, rest = step
        location = self.location if location is None else location
        assert z is not None
        size = jnp.linalg.norm(z)
        first = jnp.zeros_like(z).at[0].set(1)  # any direction will do where z vanishes
        unit = jnp.where(size > 0, z / jnp.where(size > 0, size, 1), first)
        across = back - unit * jnp.dot(unit, back)
        if rest is not None:
            length = jnp.sqrt(jnp.dot(across, across) + rest[1])
            across = across * jnp.where(length > 0, rest[0] / jnp.where(length > 0, length, 1), 0)
        product = scale * (unit * jnp.dot(ahead, y) + jnp.linalg.norm(y) * across)
        return product if location is None else product + rmatvec(location, y)


def normal_draws(key: Key[Array, ""], location: Array | None, scale: Float[Array, " T"], n: int, p: int) -> WhiteDraws:
    """Independent normal entries of standard deviation s_t about Θ_t."""
    both = jax.random.normal(key, (scale.shape[0], n + p), scale.dtype)
    return WhiteDraws(location, scale, both[:, :n], both[:, n:], None)


def sphere_draws(key: Key[Array, ""], location: Array | None, scale: Float[Array, " T"], n: int, p: int) -> WhiteDraws:
    """Uniform on Frobenius spheres of radius s_t √(n p) about Θ_t."""
    normal_key, radius_key, rest_key = jax.random.split(key, 3)
    normal = normal_draws(normal_key, location, scale, n, p)
    squared = _chi_square(radius_key, n * (p - 1), scale)
    factor = jnp.sqrt(n * p / (jnp.sum(normal.ahead**2, axis=1) + squared))
    rest = jnp.stack([jnp.sqrt(squared) * factor, _chi_square(rest_key, (n - 1) * (p - 1), scale)], axis=1)
    return WhiteDraws(location, scale, normal.ahead * factor[:, None], normal.back, rest)


def _chi_square(key: Key[Array, ""], degrees: int, like: Array) -> Array:
    if degrees == 0:
        return jnp.zeros_like(like)
    return jax.random.chisquare(key, float(degrees), like.shape, like.dtype)
