"""Policies with a given sparsity pattern."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from perfcontrol._checks import fail
from perfcontrol.sets.base import AbstractSet


class Support(AbstractSet):
    """{M : M = 0 wherever mask is False}: who may react to what; a linear subspace.

    Args:
        mask: booleans (or 0 and 1), (memory, input, state) of the free parameters, or (input, state) for every lag.

    Raises:
        InputError: a mask of other values, or one that does not fit the policy.
    """

    mask: Bool[Array, "..."]

    def __init__(self, mask: Any):
        host = np.asarray(mask)
        if host.dtype != bool:
            if host.dtype.kind not in "iuf" or not np.isin(host, (0, 1)).all():
                raise fail(
                    "mask", f"dtype {host.dtype}", "hold True and False", "Pass booleans: True marks the free entries."
                )
            host = host.astype(bool)
        if host.ndim not in (2, 3):
            raise fail(
                "mask",
                f"{host.shape}",
                "have shape (memory, input, state) or (input, state)",
                "Pass one entry per free parameter.",
            )
        self.mask = jnp.asarray(host)

    def check(self, shape: tuple[int, ...]) -> None:
        if self.mask.shape not in (shape, shape[1:]):
            raise fail(
                "mask",
                f"{self.mask.shape}",
                f"have shape (memory, input, state) = {shape} or (input, state) = {shape[1:]}",
                "Pass one entry per free parameter.",
            )

    def project(self, M: Array) -> Array:
        return jnp.where(self.mask, M, 0)

    def support(self, direction: Array) -> None:
        return None

    @property
    def affine(self) -> bool:
        return True
