"""The local rate of repeated minimisation, split over time: what the reaction of each Δ_t adds to it.

Φ' = 𝐀 𝐄 at a stable policy, with 𝐄 = ∂_2 g = Σ_t 𝐄_t (+ what the reaction of the noise adds), 𝐄_t the part that passes
through D_t alone. With the left and the right eigenvector l, r of Φ' for the eigenvalue λ of the largest modulus,

    |λ| = Σ_t Re(e^{-i arg λ} lᴴ 𝐀 𝐄_t r / lᴴ r),

and each term is how fast |λ| grows where the reaction of D_t is scaled up: first-order perturbation of an eigenvalue.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array

from perfcontrol._linalg import Matrix, along_time, as_dense
from perfcontrol._programs import program
from perfcontrol.evaluate.exact import exact_gradient
from perfcontrol.perturbations import CovarianceOperator
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.precision import in_double
from perfcontrol.theory.stability.local_model import LocalModel

COMPLETE = 1e-6  # what the terms may lack of |λ|, relative to it


class _Moved(eqx.Module):
    """A law whose moments exact evaluation finds as they are here, whatever is deployed."""

    mean: Matrix | None
    spread: CovarianceOperator
    width: int = eqx.field(static=True)

    def mean_operator(self, M: Array, horizon: int) -> Matrix | None:
        return self.mean

    def covariance(self, M: Array, horizon: int) -> CovarianceOperator:
        return self.spread

    def columns(self, state_size: int, input_size: int) -> int:
        return self.width


@program
def _through_each_time(problem: PerformativeProblem, M: Any, answer: Any, direction: Any) -> Array:
    """<answer, 𝐄_t direction> for every t, (T,); free parameters."""
    law, T = problem.perturbation, problem.horizon
    point, along = problem.structure.lift(M), problem.structure.lift(direction)

    def mean(policy: Array) -> Matrix | None:
        value = law.mean_operator(policy, T)
        return None if value is None else along_time(as_dense(value), 2, T)

    def moved(function: Any, s: Array) -> Any:
        """function(M) with the step of each time s_t along the direction; what has no time axis stays."""
        value, slope = eqx.filter_jvp(function, (point,), (along,))

        def leaf(at: Any, by: Any) -> Any:
            if by is None or not eqx.is_inexact_array(at) or at.shape[:1] != (T,):
                return at
            return at + s.reshape(T, *(1,) * (at.ndim - 1)) * by

        return jax.tree.map(leaf, value, slope, is_leaf=lambda one: one is None)

    def form(s: Array) -> Array:
        width = law.columns(problem.state_size, problem.input_size)
        world = _Moved(moved(mean, s), moved(lambda policy: law.covariance(policy, T), s), width)
        return jnp.sum(answer * exact_gradient(eqx.tree_at(lambda p: p.perturbation, problem, world), M, M))

    return jax.grad(form)(jnp.zeros(T, problem.dtype))


@in_double
def rate_by_time(problem: PerformativeProblem, model: LocalModel) -> np.ndarray | None:
    """What each Δ_t adds to the local rate |λ|, (T,): its sum, unless the noise reacts, too. May be negative.

    None where it cannot be said: an infinite horizon, an eigenvalue without an eigenvector of its own, a family whose
    moments are not given time by time.
    """
    if not problem.is_finite:
        return None
    if not model.response_jacobian.size:
        return np.zeros(problem.horizon)
    solved: Any = scipy.linalg.eig(model.response_jacobian, left=True, right=True)
    values, left, right = solved
    largest = int(np.argmax(np.abs(values)))
    rate, overlap = values[largest], np.vdot(left[:, largest], right[:, largest])
    if rate == 0:
        return np.zeros(problem.horizon)
    if abs(overlap) < COMPLETE:
        return None
    shape, basis = problem.policy_shape, model.basis
    answer = basis @ (model.answer.T @ left[:, largest].conj()) * (np.conj(rate) / abs(rate) / overlap)
    direction = basis @ right[:, largest]
    terms = np.zeros(problem.horizon)
    for sign, a, r in ((1.0, answer.real, direction.real), (-1.0, answer.imag, direction.imag)):
        if np.any(a) and np.any(r):
            terms += sign * np.asarray(_through_each_time(problem, model.M, a.reshape(shape), r.reshape(shape)))
    complete = problem.noise_reacts or abs(terms.sum() - abs(rate)) <= COMPLETE * abs(rate)
    return terms if complete and np.isfinite(terms).all() else None
