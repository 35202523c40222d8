"""Feasible sets of the free policy parameters, and linear structures of the policy."""

from perfcontrol.sets.base import AbstractSet, LiftedSet
from perfcontrol.sets.box import Box
from perfcontrol.sets.frobenius_ball import FrobeniusBall
from perfcontrol.sets.intersection import Intersection
from perfcontrol.sets.rows import RowSimplex, RowSum
from perfcontrol.sets.spectral_ball import SpectralBall
from perfcontrol.sets.structures import AbstractStructure, FullStructure, RepeatedBlock
from perfcontrol.sets.support import Support
from perfcontrol.sets.unconstrained import Unconstrained

__all__ = [
    "AbstractSet",
    "AbstractStructure",
    "Box",
    "FrobeniusBall",
    "FullStructure",
    "Intersection",
    "LiftedSet",
    "RepeatedBlock",
    "RowSimplex",
    "RowSum",
    "SpectralBall",
    "Support",
    "Unconstrained",
]
