"""The world that a deployed policy makes, as a cost-to-go: one recursion backward in time, on z = [x; u].

    Γ_t = C_t + Ā_tᵀ Λ_{t+1} Ā_t + 𝒞_t*[Λ_{t+1}],     Ā_t = [A_t, B_t] + Θ_t,
    [[Λ_t, D_tᵀ], [D_t, S_t]] = Γ_t seen through u = v - K_t x,

where C_t is the stage weight, Θ_t = E Δ_t and 𝒞_t*[X] = E (Δ-Θ)ᵀX(Δ-Θ). The closed loop does not depend on the
evaluated policy, so neither does any of this: costs, gradients, best responses and residuals share it.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._linalg import Matrix, along_time, congruence, symmetrise, transpose
from perfcontrol.evaluate.impulse_form import ImpulseForm
from perfcontrol.evaluate.loop import closed_loop
from perfcontrol.evaluate.stationary import StationaryWorld
from perfcontrol.problem import PerformativeProblem


class CostToGo(eqx.Module):
    """What the deployed policy makes of the world; none of it depends on the evaluated policy.

    first: Λ_0, (n, n). Lambda: Λ_1, ..., Λ_T, (T, n, n), the cost-to-go of what an input leads to. R (m, m), N (m, n):
    the parts of S and D that are not BᵀΛB and BᵀΛF: stage cost and perturbation of the input; with the axis T+1 where
    they vary, N None where there is no coupling. F: (n, n) mean closed loop, B: (n, m) mean input matrix, Θ included;
    with the axis T where they vary. noise_mean: (n,) or (T, n) and noise_covariance: (n, n) or (T, n, n), of the law
    of w_t.
    """

    first: Float[Array, "n n"]
    Lambda: Float[Array, "T n n"]
    R: Float[Array, "*steps m m"]
    N: Float[Array, "*between m n"] | None
    F: Matrix
    B: Matrix
    noise_mean: Float[Array, "*time n"]
    noise_covariance: Float[Array, "*times n n"]
    impulses: ImpulseForm | None = None

    @property
    def S(self) -> Float[Array, "T1 m m"]:
        """R_t + BᵀΛ_{t+1}B: curvature in the feedforward v_t; nothing lies ahead of the last one."""
        return self._with_stage(self.R, transpose(self.Lambda @ self.B) @ self.B)

    @property
    def D(self) -> Float[Array, "T1 m n"]:
        """N_t + BᵀΛ_{t+1}F: its coupling to the state."""
        return self._with_stage(self.N, transpose(self.Lambda @ self.B) @ self.F)

    def _with_stage(self, stage: Array | None, moved: Array) -> Array:
        if stage is None:
            return jnp.pad(moved, ((0, 1), (0, 0), (0, 0)))
        stages: Array = along_time(stage, 2, len(moved) + 1)
        return jnp.concatenate([stages[:-1] + moved, stages[-1:]])


def cost_to_go(problem: PerformativeProblem, reacting: Array) -> CostToGo:
    """The backward recursion under the lifted deployed policy `reacting`."""
    n = problem.state_size
    F, B, on_x, between, on_v, spread, state_part = closed_loop(problem, reacting)
    varying, on_input = F.ndim == 3, state_part is not None
    spread_steps, backward = (spread.steps, None) if varying or on_input else spread.backward(F)

    stages = symmetrise(on_x)

    def retreat(ahead: Array, step: Any) -> tuple[Array, Array]:
        """What lies ahead of t + 1 becomes what lies ahead of t; Λ_{t+1} comes out."""
        F_t, stage, spread_t, state_part_t = step
        Lambda = (stages if stage is None else stage) + ahead
        if backward is not None:
            return backward(spread_t, Lambda), Lambda
        reaction = spread.adjoint_step(spread_t, Lambda)
        moved = congruence(F_t if varying else F, Lambda)
        return moved + (congruence(state_part_t, reaction) if on_input else reaction), Lambda

    # The carry is what lies ahead, not Λ: nothing that is stored is overwritten, and XLA needs no copy.
    steps = (F if varying else None, stages[1:] if stages.ndim == 3 else None, spread_steps, state_part)
    ahead, Lambda = jax.lax.scan(retreat, jnp.zeros((n, n), on_x.dtype), steps, problem.horizon, reverse=True)
    first = (stages if stages.ndim == 2 else stages[0]) + ahead
    if state_part is not None:
        reaction = spread.adjoint(Lambda)[:, n:, :]
        last_stage = ((0, 1), (0, 0), (0, 0))  # nothing reacts after it
        on_v = on_v + jnp.pad(reaction[:, :, n:], last_stage)
        between = jnp.pad(reaction @ state_part, last_stage) + (0 if between is None else between)
    noise = problem.noise_under(reacting)
    return CostToGo(first, Lambda, on_v, between, F, B, noise.mean, noise.covariance)


World = CostToGo | StationaryWorld
