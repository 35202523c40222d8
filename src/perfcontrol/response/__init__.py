"""The best response to a deployed policy, exactly: the quadratic that it minimises, one file a method."""

from perfcontrol.response.estimate import SampleAverage, estimate_response
from perfcontrol.response.respond import (
    Response,
    best_response,
    residual,
    residual_of,
    respond,
    response_hessian,
    response_jacobian,
    response_pushforward,
    step_of,
)

__all__ = [
    "Response",
    "SampleAverage",
    "best_response",
    "estimate_response",
    "residual",
    "residual_of",
    "respond",
    "response_hessian",
    "response_jacobian",
    "response_pushforward",
    "step_of",
]
