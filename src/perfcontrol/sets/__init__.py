"""Feasible sets of the free policy parameters, and linear structures of the policy."""

from perfcontrol.sets.base import AbstractSet, LiftedSet
from perfcontrol.sets.frobenius_ball import FrobeniusBall
from perfcontrol.sets.rows import RowSimplex, RowSum
from perfcontrol.sets.structures import AbstractStructure, FullStructure, RepeatedBlock
from perfcontrol.sets.unconstrained import Unconstrained

__all__ = [
    "AbstractSet",
    "AbstractStructure",
    "FrobeniusBall",
    "FullStructure",
    "LiftedSet",
    "RepeatedBlock",
    "RowSimplex",
    "RowSum",
    "Unconstrained",
]
