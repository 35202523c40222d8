"""Linear systems and the feedback gains designed for them."""

from perfcontrol.systems.gain_design import design_gain
from perfcontrol.systems.linear import LinearSystem

__all__ = ["LinearSystem", "design_gain"]
