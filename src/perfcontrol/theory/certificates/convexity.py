"""μ̃: strong convexity of C_T(·; M') in the free parameters, uniformly over deployed policies.

Four lower bounds of the Hessian (proofs in docs: theory); the largest that applies is used.

- *printed*: the paper's min{(T-H+1)μσ²/2, (T-H+1)μσ²γ²/(64κ¹⁰)}.
- *jensen*: where E Δ_t does not depend on M', the Hessian of E Σ μ_t(‖x_t‖²+‖u_t‖²)/2 at Δ = E Δ.
- *quadratic jensen*: likewise for a quadratic cost, its own Hessian at Δ = E Δ.
- *feedforward*: for every law, μ λ_min(Σ) Σ_{t=H..T} 1/(1+‖K_t‖²); for a quadratic cost the Schur complement of the
  stage weight, seen through u = v - Kx, in place of μ/(1+‖K‖²).
"""

import equinox as eqx
import numpy as np

from perfcontrol._linalg import along_time
from perfcontrol.costs import QuadraticCost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.certificates.ingredients import Ingredients
from perfcontrol.theory.derivatives import fixed_noise, hessian, tangent_basis, without_reaction
from perfcontrol.theory.existence import constant_mean


def printed_convexity(items: Ingredients, kappa: float, gamma: float) -> float:
    """μ̃ as printed (Lemma on strong convexity), with σ² = λ_min(Cov w)."""
    scale = (items.horizon - items.memory + 1) * float(items.strong_convexity.min()) * items.noise_floor
    return min(scale / 2, scale * gamma**2 / (64 * kappa**10))


def rigorous_convexity(problem: PerformativeProblem, items: Ingredients) -> tuple[float, str]:
    """The best proved lower bound of the Hessian on the feasible set, and which one it is."""
    bounds = {"feedforward": _feedforward(problem, items)}
    mean = problem.perturbation.mean(problem.structure.lift(problem.initial_policy()), problem.horizon)
    if mean is not None and constant_mean(problem):
        if np.all(np.isfinite(items.strong_convexity)):
            bounds["jensen"] = _jensen(problem, items.strong_convexity / 2)
        if isinstance(problem.cost, QuadraticCost):
            bounds["quadratic jensen"] = _jensen(problem, None)
    name = max(bounds, key=lambda key: bounds[key])
    return bounds[name], name


def _jensen(problem: PerformativeProblem, weights: np.ndarray | None) -> float:
    """λ_min of the Hessian at Δ = E Δ along the set: of E Σ weight_t (‖x‖²+‖u‖²), or of the quadratic cost itself."""
    calm = without_reaction(problem)
    if weights is not None:
        scale = weights[:, None, None]
        cost = QuadraticCost(scale * np.eye(problem.state_size), scale * np.eye(problem.input_size))
        calm = eqx.tree_at(lambda p: p.cost, calm, cost)
    basis = tangent_basis(problem)
    if basis.shape[1] == 0:
        return np.inf
    values = np.linalg.eigvalsh(basis.T @ hessian(calm, calm.initial_policy()) @ basis)
    return max(float(values[0]) - 1e-12 * abs(float(values[-1])), 0.0)


def _feedforward(problem: PerformativeProblem, items: Ingredients) -> float:
    """The bound that looks at the feedforward v_t alone, whatever the state does."""
    n, m, T, H = problem.state_size, problem.input_size, problem.horizon, problem.memory
    gains = np.asarray(problem.gains(), dtype=float)
    norms = np.linalg.norm(gains, ord=2, axis=(-2, -1))
    covariances = np.asarray(along_time(fixed_noise(problem).covariance, 2, T), dtype=float)
    floors = np.maximum(np.linalg.eigvalsh(covariances)[:, 0], 0)
    stage = [np.eye(m) * mu / (1 + k**2) for mu, k in zip(items.strong_convexity, norms, strict=True)]
    if isinstance(problem.cost, QuadraticCost):
        weights = 2 * np.asarray(problem.cost.form(T).matrix, dtype=float)
        for t in range(T + 1):
            seen = np.block([[np.eye(n), np.zeros((n, m))], [-gains[t], np.eye(m)]])
            W = seen.T @ weights[t] @ seen
            schur = W[n:, n:] - W[n:, :n] @ np.linalg.pinv(W[:n, :n], rcond=1e-12) @ W[:n, n:]
            if np.linalg.eigvalsh(schur)[0] > np.linalg.eigvalsh(stage[t])[0]:
                stage[t] = schur
    lags = [sum(stage[t] * floors[t - i] for t in range(i, T + 1)) for i in range(1, H + 1)]
    smallest = min(float(np.linalg.eigvalsh(lag)[0]) for lag in lags)
    return max(smallest, 0.0) * items.structure_norm**2
