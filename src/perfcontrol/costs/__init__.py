"""Stage costs."""

from perfcontrol.costs.base import AbstractCost
from perfcontrol.costs.quadratic import QuadraticCost

__all__ = ["AbstractCost", "QuadraticCost"]
