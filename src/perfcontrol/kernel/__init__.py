"""A kernel in C++ for paths under dense perturbations: optional, compiled where it is used, equal to rounding."""

from perfcontrol.kernel.library import in_use, use_kernel

__all__ = ["in_use", "use_kernel"]
