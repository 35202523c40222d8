"""Intersections of feasible sets: Dykstra's projections, finished by Newton steps on their fixed-point equations.

With y the point to project, x its projection and p_i the part of y - x that set i is responsible for,

    x = P_i(x + p_i) for every set i,     y = x + Σ_i p_i,

and conversely any such x is the projection. Dykstra's sweep keeps the second equation exactly and drives the first
ones to hold; that is safe from everywhere but only linear at best, and can stall. A Newton step through the
derivatives of the P_i is tried after some sweeps, and taken where it makes the defect smaller. The same linear
system, solved once at the end, is the derivative of the projection.
"""

from perfcontrol.sets.intersection.intersection import Intersection

__all__ = ["Intersection"]
