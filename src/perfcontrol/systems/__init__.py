"""Linear systems and the feedback gains designed for them."""

from perfcontrol.systems.gain_design import design_gain
from perfcontrol.systems.growth import UnstableGainWarning
from perfcontrol.systems.growth import warn_of_growth as warn_of_growth
from perfcontrol.systems.linear import LinearSystem

__all__ = ["LinearSystem", "UnstableGainWarning", "design_gain"]
