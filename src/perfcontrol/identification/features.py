"""How a quantity may depend on the deployed policy: features of the policy, and the policy map that they make."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol.policy_maps import Affine, Function, Norm

NAMES = ("constant", "norm", "squared norm", "affine")


class Features(NamedTuple):
    """value(M) = c_0 + Σ_j c_j f_j(M), with as many coefficients for each entry of the value.

    name: for reports. function: M -> (q,), in JAX. as_map: coefficients (..., 1 + q) -> the policy map, or a constant.
    """

    name: str
    function: Callable
    as_map: Callable

    def values(self, policies: np.ndarray) -> np.ndarray:
        """(1, f(M)) for each of the policies, (G, 1 + q)."""
        with jax.ensure_compile_time_eval():  # numbers, also where somebody traces a function that asks for them
            values = np.asarray(jax.vmap(self.function)(jnp.asarray(policies)), dtype=float)
        return np.concatenate([np.ones((len(values), 1)), values], axis=1)


CONSTANT = Features("constant", lambda M: jnp.zeros(0), lambda c: c[..., 0])
NORM = Features("norm", lambda M: jnp.sqrt(jnp.sum(M**2))[None], lambda c: Norm(c[..., 0], c[..., 1]))
SQUARED_NORM = Features(
    "squared norm", lambda M: jnp.sum(M**2)[None], lambda c: Norm(c[..., 0], c[..., 1], squared=True)
)


def affine(policies: np.ndarray) -> Features:
    """Coordinates of M along the differences of the deployed policies; flat in the directions never tried."""
    flat = policies.reshape(len(policies), -1)
    _, sizes, directions = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    kept = directions[sizes > 1e-9 * max(sizes.max(initial=0.0), np.abs(flat).max(initial=0.0), 1e-300)]
    basis = kept.reshape(len(kept), *policies.shape[1:])

    def as_map(coefficients: Any) -> Any:
        return Affine(coefficients[..., 0], jnp.tensordot(coefficients[..., 1:], jnp.asarray(basis, float), axes=1))

    return Features("affine", lambda M: jnp.tensordot(jnp.asarray(basis, float), M, axes=3), as_map)


def own(name: str, function: Callable, policies: np.ndarray) -> Features:
    """A function of the user, M -> (q,)."""

    def combine(M: Array, coefficients: Array) -> Array:  # one object for all maps: a stack has one structure
        return coefficients[..., 0] + coefficients[..., 1:] @ function(M)

    features = Features(getattr(function, "__name__", "own features"), function, lambda c: Function(combine, c))
    try:
        values = features.values(policies)
    except Exception as error:
        required = f"accept a policy of shape {policies.shape[1:]} and return a vector"
        raise fail(name, f"an error from the function ({error})", required, "Write it with jax.numpy.") from error
    if values.ndim != 2 or not np.all(np.isfinite(values)):
        raise fail(name, f"values {values.tolist()}", "return a finite vector", "Return jnp.array([...]).")
    return features


def features_of(name: str, reaction: Any, policies: np.ndarray) -> Features:
    """The features that a user asked for, by name or as a function of the policy."""
    if callable(reaction):
        return own(name, reaction, policies)
    known = {"constant": CONSTANT, "norm": NORM, "squared norm": SQUARED_NORM, "affine": affine(policies)}
    key = str(reaction).replace("_", " ")
    if key not in known:
        required = f"be 'auto', a function of the policy, or one of {NAMES}"
        raise fail(name, repr(reaction), required, "Pass one of them, or a dict that sets 'mean' and 'scale' apart.")
    return known[key]
