"""A, B, noise mean and reaction of the mean, as linear functions of the fitted coefficients."""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.blocks import Block
from perfcontrol.identification.location import Location, jacobian
from perfcontrol.identification.parameter import Parameter, parameter

HIDDEN = 1e-6  # share of a functional in what is not identified, beyond which it is not either


class MeanReading(NamedTuple):
    """location and its block; gain (m, n); zero (1 + q,): the features at M = 0; width: columns that Δ acts on."""

    location: Location
    block: Block
    gain: np.ndarray
    zero: np.ndarray
    width: int

    def functionals(self) -> dict[str, np.ndarray]:
        """A, B, noise_mean: matrices (columns, p) that are applied to each row of the coefficients (n, p)."""
        m, n = self.gain.shape
        local = jacobian(self.zero[None], np.arange(n + m + 1) < self.width)[0]
        A = local[:n] + self.gain.T @ local[n : n + m]
        return {"A": A, "B": local[n : n + m], "noise_mean": local[-1:]}

    def slopes(self) -> list[np.ndarray]:
        """Θ's coefficients of each feature, (width, p): on x and u, not on x and v."""
        m, n = self.gain.shape
        out = []
        for feature in range(len(self.zero) - 1):
            first = n + m + 1 + feature * self.width
            functional = np.eye(self.width, self.location.coefficients.shape[1], k=first)
            if self.width > n:
                functional[:n] += self.gain.T @ functional[n:]
            out.append(functional)
        return out

    def estimate(self, functional: np.ndarray) -> Parameter:
        """The value (n, columns) with its standard error, infinite where it is not identified."""
        location = self.location
        n, free = len(location.coefficients), location.identified.shape[1]
        influence = self.block.influence.reshape(-1, n, free) @ (functional @ location.identified).T
        size = np.linalg.norm(location.unidentified, axis=0)
        hidden = (np.abs(functional @ location.unidentified) > HIDDEN * size).any(axis=1)
        return parameter(location.coefficients @ functional.T, influence, hidden)

    def coefficients(self, free: np.ndarray) -> np.ndarray:
        """The coefficients (n, p) for other values of the block's."""
        location = self.location
        change = (free - self.block.values).reshape(len(location.coefficients), -1)
        return location.coefficients + change @ location.identified.T

    def reaction(self, coefficients: np.ndarray) -> np.ndarray:
        """Θ as coefficients (n, width, 1 + q) by the features, zero at M = 0."""
        slopes = [coefficients @ functional.T for functional in self.slopes()]
        offset = np.zeros((len(coefficients), self.width))
        for value, slope in zip(self.zero[1:], slopes, strict=True):
            offset -= value * slope
        return np.stack([offset, *slopes], axis=-1)
