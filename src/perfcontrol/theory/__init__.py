"""Whether a stable policy exists, how fast the methods reach it, and which step is safe; each with how it is known."""

from perfcontrol.theory.certificate import Assumption, Certificate
from perfcontrol.theory.certify import certify
from perfcontrol.theory.local import hessian, reaction_jacobian
from perfcontrol.theory.mean_square import MeanSquareStability
from perfcontrol.theory.sharp import contraction_estimate, mean_square_stability, safe_step
from perfcontrol.theory.strong_stability import StrongStability, strong_stability

__all__ = [
    "Assumption",
    "Certificate",
    "MeanSquareStability",
    "StrongStability",
    "certify",
    "contraction_estimate",
    "hessian",
    "mean_square_stability",
    "reaction_jacobian",
    "safe_step",
    "strong_stability",
]
