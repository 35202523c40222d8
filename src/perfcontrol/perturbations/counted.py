"""Random matrices given by what their entries are counted from, for those who draw them themselves."""

from typing import NamedTuple

from jaxtyping import Array, Float, Key


class Counted(NamedTuple):
    """Θ_t + s_t Z_t, the entries of Z_0, Z_1, ... being the numbers of a fast key, one after the other.

    key: a fast key. scale: s, (T,). location: Θ, (n, p) or (T, n, p), None for zero. law: "rademacher", "uniform", or
    "normal": then n + p numbers a step serve the two products of `WhiteDraws`. chi: for the sphere its two χ² numbers a
    step. each: Z_t are the numbers of `fold_in(key, t)`, in place of all being numbers of `key`.
    """

    key: Key[Array, ""]
    scale: Float[Array, " T"]
    location: Float[Array, "*T n p"] | None
    law: str
    chi: Float[Array, "T 2"] | None = None
    each: bool = False
