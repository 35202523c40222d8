"""Linear systems, the feedback gains designed for them, and those that smooth maps are near an equilibrium."""

from perfcontrol.systems.gain_design import design_gain
from perfcontrol.systems.growth import UnstableGainWarning
from perfcontrol.systems.growth import warn_of_growth as warn_of_growth
from perfcontrol.systems.linear import LinearSystem
from perfcontrol.systems.linearise import Linearisation, LinearisationError, linearise

__all__ = ["LinearSystem", "Linearisation", "LinearisationError", "UnstableGainWarning", "design_gain", "linearise"]
