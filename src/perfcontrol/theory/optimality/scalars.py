"""The few scalars through which a policy sets the variances of its perturbations, and what a cell of them proves.

θ_{tk}(M) = σ_{tk}(M)² depends on s(M) alone: on a few linear functions of the policy (`Linear`, `Affine` scales), on
its distance from one policy (`Distance`, `Norm` scales), or on the sizes of the scales themselves (`Sizes`, functions
declared to have convex sublevel sets). A cell is a box low ≤ s ≤ high.
"""

import abc

import numpy as np

from perfcontrol.theory.optimality.relaxation import Least, Relaxation


class AbstractScalars(abc.ABC):
    """s(M), d numbers, policies given as (p,)."""

    low: np.ndarray  # (d,): of s over the set; may be infinite
    high: np.ndarray

    @abc.abstractmethod
    def at(self, M: np.ndarray) -> np.ndarray:
        """s(M), (d,)."""

    @abc.abstractmethod
    def variances(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """The least variances in a cell, (T, k)."""

    @abc.abstractmethod
    def spread(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """How much the scales vary over a bounded cell along each scalar, (d,)."""

    @abc.abstractmethod
    def least(self, relaxation: Relaxation, low: np.ndarray, high: np.ndarray, enough: float) -> Least:
        """A lower bound of the relaxation in a cell; more than `enough` is not needed."""
