"""Whether a stable policy exists, how fast the methods reach it, and which step is safe; each with how it is known.

Host-level: NumPy and SciPy around the exact engine; nothing here promises to work under jit or vmap.
"""

from perfcontrol.theory.certificate import KINDS, Assumption, Certificate
from perfcontrol.theory.certify import certify
from perfcontrol.theory.existence import existence
from perfcontrol.theory.local import hessian, reaction_jacobian
from perfcontrol.theory.mean_square import MeanSquareStability
from perfcontrol.theory.orders import OrderVerdict, compare_orders, order_by_bound
from perfcontrol.theory.propositions import (
    SensitivityEnvelope,
    SumThreshold,
    envelope_shape,
    sensitivity_envelope,
    sum_threshold,
)
from perfcontrol.theory.rates import (
    TheoremStepSize,
    descent_constants,
    rrm_error_bound,
    rsgd_error_bound,
    theorem_step_size,
)
from perfcontrol.theory.report import certificate_row, verdict_rows
from perfcontrol.theory.sensitivity import SensitivityEstimate, estimate_sensitivity
from perfcontrol.theory.sharp import contraction_estimate, mean_square_stability, safe_step
from perfcontrol.theory.strong_stability import StrongStability, strong_stability

__all__ = [
    "KINDS",
    "Assumption",
    "Certificate",
    "MeanSquareStability",
    "OrderVerdict",
    "SensitivityEnvelope",
    "SensitivityEstimate",
    "StrongStability",
    "SumThreshold",
    "TheoremStepSize",
    "certificate_row",
    "certify",
    "compare_orders",
    "contraction_estimate",
    "descent_constants",
    "envelope_shape",
    "estimate_sensitivity",
    "existence",
    "hessian",
    "mean_square_stability",
    "order_by_bound",
    "reaction_jacobian",
    "rrm_error_bound",
    "rsgd_error_bound",
    "safe_step",
    "sensitivity_envelope",
    "strong_stability",
    "sum_threshold",
    "theorem_step_size",
    "verdict_rows",
]
