"""Linear structures: free parameters -> the full policy (memory, input, state)."""

from perfcontrol.sets.structures.base import AbstractStructure
from perfcontrol.sets.structures.full import FullStructure
from perfcontrol.sets.structures.repeated_block import RepeatedBlock

__all__ = ["AbstractStructure", "FullStructure", "RepeatedBlock"]
