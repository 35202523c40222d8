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

from perfcontrol._linalg import times, times_transposed
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
    side_by_side: ClassVar[bool] = True

    @property
    def steps(self) -> Any:
        return varying(self.location), self.scale[:, None] * self.ahead

    def matvec_step(self, step: Any, z: Array) -> Array:
        location, ahead = step
        location = self.location if location is None else location
        product = _norm(z) * ahead
        return product if location is None else product + times(location, z)

    def steps_back(self, z: Array) -> Any:
        size = jnp.linalg.norm(z, axis=1, keepdims=True)
        first = jnp.zeros_like(z).at[:, 0].set(1)  # any direction will do where z vanishes
        unit = jnp.where(size > 0, z / jnp.where(size > 0, size, 1), first)
        across = self.back - unit * jnp.sum(unit * self.back, axis=1, keepdims=True)
        if self.rest is not None:
            length = jnp.sqrt(jnp.sum(across**2, axis=1) + self.rest[:, 1])
            across = across * jnp.where(length > 0, self.rest[:, 0] / jnp.where(length > 0, length, 1), 0)[:, None]
        scale = self.scale[:, None]
        return varying(self.location), scale * self.ahead, unit, scale * across

    def rmatvec_step(self, step: Any, y: Array) -> Array:
        location, ahead, unit, across = step
        location = self.location if location is None else location
        product = unit * jnp.sum(ahead * y, axis=0) + _norm(y) * across
        return product if location is None else product + times_transposed(location, y)


def _norm(z: Array) -> Array:
    return jnp.sqrt(jnp.sum(z**2, axis=0))


def normal_draws(key: Key[Array, ""], location: Array | None, scale: Float[Array, " T"], n: int, p: int) -> WhiteDraws:
    """Independent normal entries of standard deviation s_t about Θ_t."""
    both = jax.random.normal(key, (len(scale), n + p), scale.dtype)
    return WhiteDraws(location, scale, both[:, :n], both[:, n:], None)


def sphere_draws(key: Key[Array, ""], location: Array | None, scale: Float[Array, " T"], n: int, p: int) -> WhiteDraws:
    """Uniform on Frobenius spheres of radius s_t √(n p) about Θ_t."""
    normal_key, chi = sphere_numbers(key, scale, n, p)
    normal = normal_draws(normal_key, location, scale, n, p)
    squared, rest = chi[:, 0], chi[:, 1]
    factor = jnp.sqrt(n * p / (jnp.sum(normal.ahead**2, axis=1) + squared))
    rest = jnp.stack([jnp.sqrt(squared) * factor, rest], axis=1)
    return WhiteDraws(location, scale, normal.ahead * factor[:, None], normal.back, rest)


def sphere_numbers(key: Key[Array, ""], scale: Float[Array, " T"], n: int, p: int) -> tuple[Array, Array]:
    """The key of the normal numbers of a sphere; ρ² before it is scaled, and χ², (T, 2)."""
    normal_key, chi_key = jax.random.split(key)
    return normal_key, jnp.stack(chi_squares(chi_key, (n * (p - 1), (n - 1) * (p - 1)), scale), axis=1)


def chi_squares(key: Key[Array, ""], degrees: tuple[int, ...], like: Float[Array, " T"]) -> list[Float[Array, " T"]]:
    """Independent χ² numbers of several degrees of freedom, by rejection, all of them in one loop.

    One proposal in twenty is rejected at two degrees of freedom, one in six thousand at 380: rounds are few.

    References:
        G. Marsaglia and W. W. Tsang, *A simple method for generating gamma variables*, ACM TOMS 26 (2000).
    """
    rejection_key, normal_key = jax.random.split(key)
    shape = len(degrees), *like.shape
    d = jnp.asarray([max(count, 2) / 2 - 1 / 3 for count in degrees], like.dtype)[:, None]

    def propose(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, numbers, accepted = carry
        x_key, u_key = jax.random.split(jax.random.fold_in(rejection_key, count))
        x, u = jax.random.normal(x_key, shape, like.dtype), jax.random.uniform(u_key, shape, like.dtype)
        v = (1 + x / jnp.sqrt(9 * d)) ** 3
        log_v = jnp.log(jnp.where(v > 0, v, 1))
        good = (v > 0) & (jnp.log(u) < x**2 / 2 + d * (1 - v + log_v))
        return count + 1, jnp.where(accepted, numbers, 2 * d * v), accepted | good

    start = jnp.zeros((), jnp.int32), jnp.zeros(shape, like.dtype), jnp.zeros(shape, bool)
    _, numbers, _ = jax.lax.while_loop(lambda carry: ~jnp.all(carry[2]), propose, start)
    few = jnp.zeros_like(like), jax.random.normal(normal_key, like.shape, like.dtype) ** 2
    return [few[count] if count < 2 else row for count, row in zip(degrees, numbers, strict=True)]
