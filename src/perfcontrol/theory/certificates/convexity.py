"""μ̃: strong convexity of C_T(·; M') in the free parameters, uniformly over deployed policies.

Four lower bounds of the Hessian (proofs in docs: theory); the largest that applies is used.

- *printed*: the paper's min{(T-H+1)μσ²/2, (T-H+1)μσ²γ²/(64κ¹⁰)}.
- *jensen*: where E Δ_t does not depend on M', the Hessian of E Σ μ_t(‖x_t‖²+‖u_t‖²)/2 at Δ = E Δ.
- *quadratic jensen*: likewise for a quadratic cost, its own Hessian at Δ = E Δ.
- *feedforward*: for every law, μ λ_min(Σ) Σ_{t=H..T} 1/(1+‖K_t‖²); for a quadratic cost the Schur complement of the
  stage weight, seen through u = v - Kx, in place of μ/(1+‖K‖²).
"""

import numpy as np

from perfcontrol.costs import QuadraticCost
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.certificates.ingredients import Ingredients
from perfcontrol.theory.derivatives import hessian_without_reaction, tangent_basis
from perfcontrol.theory.existence import constant_mean
from perfcontrol.theory.facts import facts


def printed_convexity(items: Ingredients, kappa: float, gamma: float) -> float:
    """μ̃ as printed (Lemma on strong convexity), with σ² = λ_min(Cov w)."""
    scale = (items.horizon - items.memory + 1) * float(items.strong_convexity.min()) * items.noise_floor
    return min(scale / 2, scale * gamma**2 / (64 * kappa**10))


def rigorous_convexity(problem: PerformativeProblem, items: Ingredients) -> tuple[float, str]:
    """The best proved lower bound of the Hessian on the feasible set, and which one it is."""
    bounds = {"feedforward": _feedforward(problem, items)}
    if facts(problem).perturbation_mean is not None and constant_mean(problem):
        if np.all(np.isfinite(items.strong_convexity)):
            bounds["jensen"] = _jensen(problem, items.strong_convexity / 2)
        if isinstance(problem.cost, QuadraticCost):
            bounds["quadratic jensen"] = _jensen(problem, None)
    name = max(bounds, key=lambda key: bounds[key])
    return bounds[name], name


def _jensen(problem: PerformativeProblem, weights: np.ndarray | None) -> float:
    """λ_min of the Hessian at Δ = E Δ along the set: of E Σ weight_t (‖x‖²+‖u‖²), or of the quadratic cost itself."""
    basis = tangent_basis(problem)
    if basis.shape[1] == 0:
        return np.inf
    values = np.linalg.eigvalsh(basis.T @ hessian_without_reaction(problem, weights) @ basis)
    return max(float(values[0]) - 1e-12 * abs(float(values[-1])), 0.0)


def _feedforward(problem: PerformativeProblem, items: Ingredients) -> float:
    """The bound that looks at the feedforward v_t alone, whatever the state does."""
    n, m, T, H = problem.state_size, problem.input_size, problem.horizon, problem.memory
    K, known = np.asarray(problem.gain, dtype=float), facts(problem)
    gains = np.broadcast_to(K, (T + 1, m, n))
    norms = np.linalg.norm(gains, ord=2, axis=(-2, -1))
    covariances = np.broadcast_to(np.asarray(known.noise_covariance, dtype=float), (T, n, n))
    floors = np.maximum(np.linalg.eigvalsh(covariances)[:, 0], 0)
    stage = [np.eye(m) * mu / (1 + k**2) for mu, k in zip(items.strong_convexity, norms, strict=True)]
    if known.stage_matrix is not None:
        weights = 2 * known.stage_matrix.astype(float)
        for t in range(T + 1):
            seen = np.block([[np.eye(n), np.zeros((n, m))], [-gains[t], np.eye(m)]])
            W = seen.T @ weights[t] @ seen
            schur = W[n:, n:] - W[n:, :n] @ np.linalg.pinv(W[:n, :n], rcond=1e-12) @ W[:n, n:]
            if np.linalg.eigvalsh(schur)[0] > np.linalg.eigvalsh(stage[t])[0]:
                stage[t] = schur
    lags = [sum(stage[t] * floors[t - i] for t in range(i, T + 1)) for i in range(1, H + 1)]
    smallest = min(float(np.linalg.eigvalsh(lag)[0]) for lag in lags)
    return max(smallest, 0.0) * items.structure_norm**2
