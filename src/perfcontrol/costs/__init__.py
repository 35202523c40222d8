"""Stage costs."""

from perfcontrol.costs.base import AbstractCost
from perfcontrol.costs.convex import ConvexCost
from perfcontrol.costs.functions import Huber, LinearExponential, LogCosh, OneSidedQuadratic
from perfcontrol.costs.quadratic import QuadraticCost

__all__ = [
    "AbstractCost",
    "ConvexCost",
    "Huber",
    "LinearExponential",
    "LogCosh",
    "OneSidedQuadratic",
    "QuadraticCost",
]
