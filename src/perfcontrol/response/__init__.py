"""The best response to a deployed policy, exactly: the quadratic that it minimises, one file a method."""

from perfcontrol.response.respond import (
    Response,
    best_response,
    residual,
    residual_of,
    respond,
    response_hessian,
    response_jacobian,
    response_pushforward,
)

__all__ = [
    "Response",
    "best_response",
    "residual",
    "residual_of",
    "respond",
    "response_hessian",
    "response_jacobian",
    "response_pushforward",
]
