"""λ_t, ν, ϑ_t and the bounds of state and input: the paper's as printed, repaired, and rigorous.

Write Ã_j = A_j - B_jK_j, Φ_{t,i} = (Ã_{t-1}+Δ_{t-1})⋯(Ã_{i+1}+Δ_{i+1}) (largest index on the left), and let
a_j bound ‖Q⁻¹(Ã_j+Δ_j)Q‖ and q = ‖Q‖‖Q⁻¹‖, so that ‖Φ_{t,i}‖ ≤ q Π_{i<j<t} a_j;
α_t = Π_{i<t} a_i, β_t = Σ_{i<t} Π_{i<j<t} a_j. The rigorous constants are derived in docs: theory.
"""

from dataclasses import dataclass

import numpy as np

from perfcontrol.theory.certificates.ingredients import Ingredients
from perfcontrol.theory.stability.strong_stability import StrongStability


@dataclass(frozen=True)
class Constants:
    """Bounds that hold on the feasible set, or are printed as if they did.

    alpha, beta: (T+1,). state_bound, input_bound: of ‖x_t‖, ‖u_t‖, (T+1,). smoothness: λ_t, (T+1,): Lipschitz
    constant of ∇_M c_t in M, in ‖·‖_F of the free parameters. gradient: ϑ_t ≥ ‖∇_M c_t‖_F, (T+1,). propagation:
    ν_{t,k}, (T+1, T): effect of Δ_k on ∇_M c_t per unit of spectral norm, zero for k ≥ t. variance: bound of
    Var ∇J_T.
    """

    alpha: np.ndarray
    beta: np.ndarray
    state_bound: np.ndarray
    input_bound: np.ndarray
    smoothness: np.ndarray
    gradient: np.ndarray
    propagation: np.ndarray
    variance: float

    @property
    def weights(self) -> np.ndarray:
        """Σ_{t>k} ν_{t,k} for every k, (T,): what one unit of ε_k adds to the aggregate."""
        return self.propagation.sum(axis=0)

    @property
    def total_smoothness(self) -> float:
        """Σ_t λ_t."""
        return float(self.smoothness.sum())


def growth(factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """α_t = Π_{i<t} a_i and β_{t+1} = a_t β_t + 1, β_0 = 0, for t = 0..T, each (T+1,)."""
    alpha = np.concatenate([[1.0], np.cumprod(factors)])
    beta = np.zeros(len(factors) + 1)
    for t, a in enumerate(factors):
        beta[t + 1] = a * beta[t] + 1
    return alpha, beta


def products(factors: np.ndarray) -> np.ndarray:
    """A[t, k] = Π_{k<j<t} a_j for k < t, zero elsewhere, (T+1, T)."""
    T = len(factors)
    out = np.zeros((T + 1, T))
    for k in range(T):
        out[k + 1, k] = 1.0
        for t in range(k + 2, T + 1):
            out[t, k] = out[t - 1, k] * factors[t - 1]
    return out


def rigorous_constants(items: Ingredients, stability: StrongStability) -> Constants:
    """The corrected constants; valid for every finite horizon, also where Ã is unstable.

    With s = √H W, b = ‖B‖, k = ‖K‖, z_t = q b β_t, p_t = s √(z_t² + (1 + k z_t)²) (the norm of M ↦ (x_t, u_t)):
    D_t = q[x₀α_t + (b M̄ s + W)β_t] ≥ ‖x_t‖,  k D_t + M̄ s ≥ ‖u_t‖,  U_t the larger,  λ_t = ς_t p_t²,
    ϑ_t = s(1 + (1+k) z_t)(G_t U_t + g_t),
    ν_{t,k} = q A_{t,k} [ς_t p_t √(1+k²) D_k + b s q β_k (1+k)(G_t U_t + g_t)].
    """
    q, k, b = stability.condition, stability.gain_norm, items.input_norm
    norms = np.linalg.norm(np.atleast_3d(stability.L.T).T, ord=2, axis=(-2, -1))
    a = np.broadcast_to(norms, (items.horizon,)) + q * items.perturbation_bound
    alpha, beta = growth(a)
    s = np.sqrt(items.memory) * items.noise_bound
    state = q * (items.initial_bound * alpha + (b * items.policy_bound * s + items.noise_bound) * beta)
    inputs = k * state + items.policy_bound * s
    z = q * b * beta
    response = s * np.hypot(z, 1 + k * z)
    slope = items.gradient_bound * np.maximum(state, inputs) + items.gradient_offset
    gradient = s * (1 + (1 + k) * z) * slope
    through_state = items.smoothness * response * np.sqrt(1 + k**2)
    through_product = b * s * q * (1 + k) * slope
    propagation = (
        q * products(a) * (through_state[:, None] * state[None, :-1] + through_product[:, None] * beta[None, :-1])
    )
    lift = items.structure_norm
    with np.errstate(over="ignore"):  # a bound that overflows is infinite: it proves nothing
        variance = float(np.square(lift * gradient.sum()))
    return Constants(
        alpha,
        beta,
        state,
        inputs,
        lift**2 * items.smoothness * response**2,
        lift * gradient,
        lift * propagation,
        variance,
    )


def _scalars(items: Ingredients) -> tuple[float, float]:
    return float(items.smoothness.max()), float(items.gradient_bound.max())


def printed_constants(items: Ingredients, kappa: float, gamma: float) -> Constants:
    """The constants as printed, those of the appendix where the main text differs.

    References:
        Lemmas on the norm of x_t, gradient norms, gradient variance and smoothness (Appendix C).
    """
    varsigma, G = _scalars(items)
    H, W, b, bar, x0 = items.memory, items.noise_bound, items.input_norm, items.policy_bound, items.initial_bound
    alpha, beta = growth(1 - gamma + kappa**2 * items.perturbation_bound)
    k23, k45 = kappa**2 + kappa**3, kappa**4 + kappa**5
    root, reach = items.state_size * np.sqrt(H), x0 * alpha + (b * H * bar + 1) * W * beta
    state = kappa**2 * reach
    smoothness = root * varsigma * H**2 * W**2 * (1 + b * k23) * (k23 * beta + 1)
    nu = root * (varsigma * H * W * (1 + b * k23) * k23 + G * k45 * H * W * b * beta) / (1 - gamma) * reach
    gradient_factor = kappa**3 * b * beta + 1
    gradient = (
        items.state_size**2
        * H
        * ((kappa * b * H * W * beta + gradient_factor) * kappa**3 * G * reach + gradient_factor * G * bar * H * W)
    )
    return _aggregate(items, alpha, beta, state, kappa * state + bar * H * W, smoothness, gradient, nu)


def repaired_constants(items: Ingredients, kappa: float, gamma: float) -> Constants:
    """The printed constants with their slips mended and nothing else improved.

    Mended: the factors β_t and ‖B‖ in λ_t and ν_t, the outer κ² of the product differences, the bound of ∇c by both
    ‖x‖ and ‖u‖. Kept: κ for both ‖K‖ and the transform, H W for √H W, the dimension factor d_x √H and 1/(1-γ).
    """
    varsigma, G = _scalars(items)
    H, W, b, bar, x0 = items.memory, items.noise_bound, items.input_norm, items.policy_bound, items.initial_bound
    alpha, beta = growth(1 - gamma + kappa**2 * items.perturbation_bound)
    window, root = H * W, items.state_size * np.sqrt(H)
    reach = x0 * alpha + (b * H * bar + 1) * W * beta
    state = kappa**2 * reach
    inputs = kappa * state + bar * window
    response = window * ((1 + kappa) * kappa**2 * b * beta + 1)
    slope = G * np.maximum(state, inputs) + items.gradient_offset.max()
    smoothness = root * varsigma * response**2
    through_state = varsigma * response * (1 + kappa) * kappa**4 * reach
    through_product = window * b * (1 + kappa) * kappa**4 * beta * slope
    nu = root * (through_state + through_product) / (1 - gamma)
    return _aggregate(items, alpha, beta, state, inputs, smoothness, root * response * slope, nu)


def _aggregate(
    items: Ingredients,
    alpha: np.ndarray,
    beta: np.ndarray,
    state: np.ndarray,
    inputs: np.ndarray,
    smoothness: np.ndarray,
    gradient: np.ndarray,
    nu: np.ndarray,
) -> Constants:
    """Constants whose ν_t does not depend on k; sums over t start at 1."""
    lift, T = items.structure_norm, items.horizon
    later = np.arange(T + 1)[:, None] > np.arange(T)[None, :]
    smoothness = np.concatenate([[0.0], smoothness[1:]])
    gradient = np.concatenate([[0.0], gradient[1:]])
    return Constants(
        alpha,
        beta,
        state,
        inputs,
        lift**2 * smoothness,
        lift * gradient,
        lift * later * nu[:, None],
        float(T * np.sum((lift * gradient) ** 2)),
    )
