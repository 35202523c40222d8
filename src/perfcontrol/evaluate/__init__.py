"""What a policy costs: by simulation and exactly; its gradients; its best response."""

from perfcontrol.evaluate.adjoint import path_gradient, recover_noise, sample_gradient
from perfcontrol.evaluate.estimate import Estimate, estimate_cost
from perfcontrol.evaluate.exact import expected_cost, expected_gradient
from perfcontrol.evaluate.moments import StateMoments, expected_cost_by_moments, state_moments
from perfcontrol.evaluate.rollout import Trajectories, simulate

__all__ = [
    "Estimate",
    "StateMoments",
    "Trajectories",
    "estimate_cost",
    "expected_cost",
    "expected_cost_by_moments",
    "expected_gradient",
    "path_gradient",
    "recover_noise",
    "sample_gradient",
    "simulate",
    "state_moments",
]
