"""The problem that fitted numbers make."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol.identification.features import Features
from perfcontrol.perturbations import AbstractPerturbation, DirectionalPerturbation, NoPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_vectors import Gaussian
from perfcontrol.systems import LinearSystem


class Coefficients(eqx.Module):
    """Everything that a fitted problem is built from; a leading axis makes a stack.

    A, B, noise mean and covariance; mean (n, p, 1+q) and scale (k, 1+q): coefficients by the features of the policy;
    directions (k, n, p); mean and covariance of the initial state.
    """

    A: Any
    B: Any
    noise_mean: Any
    noise_covariance: Any
    mean: Any
    scale: Any
    directions: Any
    start_mean: Any
    start_covariance: Any


def build(
    c: Coefficients,
    *,
    features: tuple[Features, Features],
    names: tuple[Any, Any],
    law: str,
    initial_state: Any,
    **world: Any,
) -> PerformativeProblem:
    """The problem of coefficients by the features of mean and scale; `names` of states and inputs; works under vmap."""
    c = jax.tree.map(lambda numbers: jnp.asarray(numbers, float), c)
    if initial_state is None:
        initial_state = Gaussian(c.start_mean, c.start_covariance)
    return PerformativeProblem(
        initial_state=initial_state,
        system=LinearSystem(c.A, c.B, *names),
        noise=Gaussian(c.noise_mean, c.noise_covariance),
        perturbation=_perturbation(c, *features, law),
        **world,
    )


def _perturbation(c: Coefficients, mean: Features, scale: Features, law: str) -> AbstractPerturbation:
    reaction = mean.as_map(c.mean) if c.mean.shape[-1] > 1 else None
    if len(c.directions):
        # The fit leaves the sign of a constant scale open; the family takes none below zero.
        sigma = scale.as_map(c.scale if c.scale.shape[-1] > 1 else jnp.abs(c.scale))
        return DirectionalPerturbation(c.directions, sigma, reaction, law)
    if reaction is not None:
        return DirectionalPerturbation(jnp.zeros((1, *c.mean.shape[:2])), jnp.zeros(1), reaction, law)
    return NoPerturbation()


def logged_start(first: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the first states (E, n), with weights (E,) on the episodes."""
    share = weights / weights.sum() if weights.sum() > 0 else np.full(len(first), 1 / len(first))
    mean = share @ first
    centred = first - mean
    return mean, (centred * share[:, None]).T @ centred
