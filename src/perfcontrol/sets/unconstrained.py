"""All policies."""

from jaxtyping import Array

from perfcontrol.sets.base import AbstractSet


class Unconstrained(AbstractSet):
    """No constraint."""

    def project(self, M: Array) -> Array:
        return M

    def support(self, direction: Array) -> None:
        return None

    @property
    def affine(self) -> bool:
        return True
