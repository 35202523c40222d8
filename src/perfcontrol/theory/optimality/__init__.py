"""How good the performative optimum can be: a proved interval for its cost."""

from perfcontrol.theory.optimality.bound import OptimalityBound, optimality_bound

__all__ = ["OptimalityBound", "optimality_bound"]
