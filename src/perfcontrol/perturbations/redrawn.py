"""Random matrices that are drawn again each time they are met, from a key and the time: none of them is held."""

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float, Int, Key

from perfcontrol.perturbations.base import MetDraws, varying

HELD = 2**27  # bytes of a path's matrices up to which they are held: drawing them twice costs JAX's own keys time


class RedrawnDraws(MetDraws):
    """Θ_t + S_t ∘ Z_t, where Z_t = white(fold_in(key, t)) is the same whenever it is asked for.

    white: key -> Z, (n, p). scale: S, to be broadcast to (n, p), and location: Θ, None for zero; both with a leading
    axis T in front of two others where they vary.
    """

    key: Key[Array, ""]
    times: Int[Array, " T"]
    white: Callable[[Array], Array]
    scale: Float[Array, "..."]
    location: Float[Array, "*T n p"] | None

    @property
    def steps(self) -> Any:
        return self.times, varying(self.scale), varying(self.location)

    def matrix(self, step: Any) -> Array:
        t, scale, location = step
        matrix = (self.scale if scale is None else scale) * self.white(jax.random.fold_in(self.key, t))
        location = self.location if location is None else location
        return matrix if location is None else matrix + location
