"""Stability of the closed loop, and of the methods near a stable policy."""
