"""Whether a stable policy exists, how fast the methods reach it, and which step is safe; each with how it is known.

Host-level: NumPy and SciPy around the exact engine, in double precision also where the problem is in single precision
(`precision`); nothing here promises to work under jit or vmap.
"""

from perfcontrol.evaluate.reaction import reaction_jacobian
from perfcontrol.theory.assumptions import Assumption
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.certify import KINDS, certify
from perfcontrol.theory.certificates.global_bound import GlobalBound
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.certificates.paper import Paper
from perfcontrol.theory.certificates.report import certificate_row, verdict_rows
from perfcontrol.theory.certificates.rigorous import Rigorous
from perfcontrol.theory.certificates.sharp import Sharp
from perfcontrol.theory.derivatives import hessian
from perfcontrol.theory.existence import Existence, existence
from perfcontrol.theory.optimality import OptimalityBound, optimality_bound
from perfcontrol.theory.price import PriceOfStability, price_of_stability
from perfcontrol.theory.rates.error_bounds import rrm_error_bound, rsgd_error_bound
from perfcontrol.theory.rates.orders import OrderVerdict, compare_orders, order_by_bound
from perfcontrol.theory.rates.propositions import (
    SensitivityEnvelope,
    SumThreshold,
    envelope_shape,
    sensitivity_envelope,
    sum_threshold,
)
from perfcontrol.theory.rates.step_size import TheoremStepSize, descent_constants, theorem_step_size
from perfcontrol.theory.sensitivity import SensitivityEstimate, estimate_sensitivity
from perfcontrol.theory.stability.contraction import contraction_estimate
from perfcontrol.theory.stability.mean_square import MeanSquareStability
from perfcontrol.theory.stability.safe_step import mean_square_stability, safe_step
from perfcontrol.theory.stability.strong_stability import StrongStability, strong_stability

__all__ = [
    "KINDS",
    "AbstractCertificateKind",
    "Assumption",
    "Certificate",
    "Existence",
    "GlobalBound",
    "MeanSquareStability",
    "OptimalityBound",
    "OrderVerdict",
    "Paper",
    "PriceOfStability",
    "Rigorous",
    "SensitivityEnvelope",
    "SensitivityEstimate",
    "Sharp",
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
    "optimality_bound",
    "order_by_bound",
    "price_of_stability",
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
