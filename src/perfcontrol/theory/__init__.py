"""Whether a stable policy exists, how fast the methods reach it, and which step is safe; each with how it is known."""

from perfcontrol.theory.certificate import Assumption, Certificate
from perfcontrol.theory.certify import certify
from perfcontrol.theory.mean_square import MeanSquareStability
from perfcontrol.theory.sharp import contraction_estimate, mean_square_stability, safe_step

__all__ = [
    "Assumption",
    "Certificate",
    "MeanSquareStability",
    "certify",
    "contraction_estimate",
    "mean_square_stability",
    "safe_step",
]
