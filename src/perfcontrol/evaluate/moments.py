"""Exact mean and second moment of the state along time: the forward recursion.

Slower than the cost-to-go form for costs, but it answers what the state does, and it is the engine's oracle:
the two share the problem and nothing else. With v_t the feedforward and z = [x; u]:
    E[x_t w_{t-i}ᵀ] =: X_t^(i),  E[x vᵀ] = Σ_i X^(i) M[i-1]ᵀ,  P_{t+1} = Ā E[zzᵀ] Āᵀ + 𝒞[E zzᵀ] + W + cross terms.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._checks import check_finite
from perfcontrol._linalg import along_time, as_dense, symmetrise
from perfcontrol._programs import program
from perfcontrol.evaluate.exact import check_digits
from perfcontrol.evaluate.loop import known_covariance, require_moments
from perfcontrol.evaluate.rollout import check_pair
from perfcontrol.evaluate.world import world_of
from perfcontrol.policy import lagged
from perfcontrol.problem import PerformativeProblem, check_end


class StateMoments(eqx.Module):
    """Moments of z_t = [x_t; u_t] for t = 0..T.

    Attributes:
        mean: E z_t, (T+1, n+m).
        second: E z_t z_tᵀ, not centred, (T+1, n+m, n+m).
    """

    mean: Float[Array, "T1 p"]
    second: Float[Array, "T1 p p"]

    @property
    def covariance(self) -> Array:
        """Cov z_t, (T+1, n+m, n+m)."""
        return self.second - self.mean[:, :, None] * self.mean[:, None, :]


def mean_dynamics(problem: PerformativeProblem, reacting: Array) -> tuple[Array, Array]:
    """[A_t, B_t] + Θ_t, (T, n, n+m), and the matrix [[I, 0], [-K_t, I]] from [x; v] to [x; u], (T+1, n+m, n+m)."""
    n, m, T = problem.state_size, problem.input_size, problem.horizon
    known_covariance(problem, reacting)
    Theta = problem.perturbation.mean(reacting, T)
    assert Theta is not None  # where the covariance is known, so is the mean
    A, B = as_dense(problem.system.A), as_dense(problem.system.B)
    joint = jnp.concatenate([along_time(A, 2, T), along_time(B, 2, T)], axis=-1)
    joint = joint.at[..., : Theta.shape[-1]].add(Theta)
    eye = jnp.eye(n + m, dtype=joint.dtype)
    return joint, jnp.broadcast_to(eye, (T + 1, n + m, n + m)).at[:, n:, :n].set(-problem.gains())


def moments_of(problem: PerformativeProblem, policy: Array, reacting: Array) -> StateMoments:
    """The forward recursion for lifted policies; pure."""
    n, m, H, T = problem.state_size, problem.input_size, problem.memory, problem.horizon
    joint, through_gain = mean_dynamics(problem, reacting)
    spread = known_covariance(problem, reacting)
    columns = problem.perturbation.columns(n, m)
    noise = problem.noise_under(reacting)
    w = along_time(noise.mean, 1, T)
    covariance = along_time(noise.covariance, 2, T)
    second_w = covariance + w[:, :, None] * w[:, None, :]
    past = lagged(w, H)  # (T+1, H, n): means of w_{t-i}
    # E[w_{t-i} w_{t-j}ᵀ], (T+1, H, H, n, n): the mean product, plus the covariance where the lags agree
    products = past[:, :, None, :, None] * past[:, None, :, None, :]
    lagged_covariance = lagged(covariance.reshape(T, n * n), H).reshape(T + 1, H, n, n)
    diagonal = jnp.arange(H)
    products = products.at[:, diagonal, diagonal].add(lagged_covariance)
    v_mean = jnp.einsum("imn,tin->tm", policy, past)
    v_second = jnp.einsum("imn,tijnk,jlk->tml", policy, products, policy)
    v_past = jnp.einsum("imn,tijnk->tjmk", policy, products)  # E[v_t w_{t-j}ᵀ]

    def stage_moments(mean: Array, P: Array, X: Array, t: Any) -> tuple[Array, Array]:
        through, v_mean_t, v_second_t = t
        cross = jnp.einsum("ink,imk->nm", X, policy)  # E[x vᵀ]
        second_xv = jnp.block([[P, cross], [cross.T, v_second_t]])
        return through @ jnp.concatenate([mean, v_mean_t]), through @ second_xv @ through.T

    def advance(carry: Any, step: Any) -> tuple[Any, Any]:
        mean, P, X = carry
        joint_t, through, v_mean_t, v_second_t, v_past_t, past_t, w_t, second_w_t, spread_t = step
        z_mean, z_second = stage_moments(mean, P, X, (through, v_mean_t, v_second_t))
        driven = joint_t @ z_mean  # E[x_{t+1}] without w_t
        reaction = spread.apply_step(spread_t, z_second[:columns, :columns])
        mixed = jnp.outer(driven, w_t)
        following = symmetrise(joint_t @ z_second @ joint_t.T + reaction + second_w_t + mixed + mixed.T)
        # E[z_t w_{t-i}ᵀ] moves one lag on
        xv_past = jnp.concatenate([X, v_past_t], axis=1)
        moved = jnp.einsum("ab,ibk->iak", joint_t @ through, xv_past) + w_t[None, :, None] * past_t[:, None, :]
        X_next = jnp.concatenate([(mixed + second_w_t)[None], moved[:-1]])
        return (driven + w_t, following, X_next), (z_mean, z_second)

    x_mean = problem.initial_state.mean.astype(policy.dtype)
    x_second = problem.initial_state.covariance + jnp.outer(x_mean, x_mean)
    start = (x_mean, x_second.astype(policy.dtype), jnp.zeros((H, n, n), policy.dtype))
    steps = (
        joint,
        through_gain[:-1],
        v_mean[:-1],
        v_second[:-1],
        v_past[:-1],
        past[:-1],
        w,
        second_w,
        spread.steps,
    )
    (mean, P, X), (means, seconds) = jax.lax.scan(advance, start, steps)
    last = stage_moments(mean, P, X, (through_gain[-1], v_mean[-1], v_second[-1]))
    return StateMoments(jnp.concatenate([means, last[0][None]]), jnp.concatenate([seconds, last[1][None]]))


def cost_by_moments(problem: PerformativeProblem, M: Array, deployed: Array) -> Array:
    """C_T(M; deployed) from the forward recursion; pure."""
    moments = moments_of(problem, problem.structure.lift(M), problem.structure.lift(deployed))
    form = problem.cost.form(problem.horizon)  # type: ignore[attr-defined]
    return jnp.sum(form.matrix * moments.second) + 2 * jnp.sum(form.linear * moments.mean) + jnp.sum(form.constant)


_compiled_moments = program(
    lambda problem, M, deployed: moments_of(problem, problem.structure.lift(M), problem.structure.lift(deployed)),
    on_device=True,
)
_compiled_cost = program(cost_by_moments, on_device=True)


def state_moments(problem: PerformativeProblem, M: Any, *, deployed: Any = None) -> StateMoments:
    """Exact mean and second moment of [x_t; u_t] for t = 0..T under policy M while the world reacts to `deployed`.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise, the policy that the world reacts to; None for M itself.

    Raises:
        InputError: wrong shapes, or a perturbation without known moments.
    """
    M, reacting = check_pair(problem, M, deployed)
    require_moments(problem)
    check_end(problem)
    return check_finite("the state moments", _compiled_moments(problem, M, reacting))


def expected_cost_by_moments(problem: PerformativeProblem, M: Any, *, deployed: Any = None) -> Array:
    """`expected_cost` by the forward moment recursion: slower, kept as an independent check of the engine.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise, the policy that the world reacts to; None for M itself.
    """
    M, reacting = check_pair(problem, M, deployed)
    require_moments(problem)
    check_end(problem)
    cost = check_finite("the expected cost", _compiled_cost(problem, M, reacting))
    check_digits(cost, problem, world_of(problem, reacting))
    return cost
