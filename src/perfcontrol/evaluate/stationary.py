"""The stationary limit: what a deployed policy makes of a time-invariant world in the long run, per stage.

    Λ = Q_K + 𝒯(Λ),    𝒯(X) = FᵀXF + [I; -K]ᵀ 𝒞*[X] [I; -K],

which has a solution exactly where the world is mean-square stable, ρ(𝒯) < 1. An impulse meets the blocks
G[j,j] = S, G[j,i<j] = D F^{j-i-1} B, G[j,0] = D F^{j-1}; means settle at μ = (I - F)⁻¹ (B v̄ + w̄).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._linalg import Matrix, as_dense, congruence, matvec, rmatvec, symmetrise, transpose
from perfcontrol._programs import program
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.impulse_form import ImpulseForm
from perfcontrol.evaluate.loop import Loop, closed_loop
from perfcontrol.evaluate.lyapunov import Operator, is_stable, solve_fixed_point, spectral_radius
from perfcontrol.problem import PerformativeProblem


class StationaryWorld(eqx.Module):
    """What the deployed policy makes of the world in the long run; NaN where ρ(𝒯) ≥ 1.

    Lambda: (n, n) cost-to-go. Q (n, n), N (m, n), R (m, m): what a stage with given means of x and v costs, the
    multiplicative noise that these excite included. F: (n, n) mean closed loop, B: (n, m) mean input matrix, Θ
    included. noise_mean: (n,) and noise_covariance: (n, n), of the law of w_t. impulses: None if not computed yet.
    """

    Lambda: Float[Array, "n n"]
    Q: Float[Array, "n n"]
    N: Float[Array, "m n"]
    R: Float[Array, "m m"]
    F: Matrix
    B: Matrix
    noise_mean: Float[Array, " n"]
    noise_covariance: Float[Array, "n n"]
    impulses: ImpulseForm | None = None

    @property
    def S(self) -> Array:
        """R + BᵀΛB, (m, m): curvature in the feedforward."""
        return self.R + congruence(self.B, self.Lambda)

    @property
    def D(self) -> Array:
        """N + BᵀΛF, (m, n): its coupling to the state."""
        return self.N + transpose(self.B) @ self.Lambda @ self.F

    def settled(self, push: Array) -> Array:
        """(I - F)⁻¹ push: where the mean state settles under a constant push, (n,) or (n, k)."""
        return jnp.linalg.solve(jnp.eye(len(self.Lambda), dtype=push.dtype) - as_dense(self.F), push)

    def chains(self, memory: int) -> tuple[Array, Array]:
        """Blocks between lags j and j-d, the same at every j, at [d, j-1], (H, H, m, m); between j and 0, (H, m, n)."""
        Y, X = [self.D], [self.S]
        for _ in range(1, memory):
            X.append(Y[-1] @ self.B)
            Y.append(Y[-1] @ self.F)
        blocks = jnp.stack(X)
        return jnp.broadcast_to(blocks[:, None], (memory, *blocks.shape)), jnp.stack(Y)

    def sustained(self) -> Array:
        """(m, m): the quadratic form per stage that a constant feedforward meets."""
        state = self.settled(as_dense(self.B))
        coupled = self.N @ state
        return self.R + coupled + coupled.T + congruence(state, self.Q)


def _constant(matrix: Any) -> Any:
    """The matrix without its time axis."""
    return jax.tree.map(lambda leaf: leaf[0], matrix) if matrix.ndim == 3 else matrix


def _second_moments(loop: Loop) -> tuple[Matrix, Operator, Operator]:
    """F, 𝒯 and 𝒞*."""
    F = _constant(loop.F)
    step = jax.tree.map(lambda leaf: leaf[0], loop.spread.steps)

    def reaction(X: Array) -> Array:
        return loop.spread.adjoint_step(step, X)

    def operator(X: Array) -> Array:
        excited = reaction(X)
        return congruence(F, X) + (excited if loop.state_part is None else congruence(loop.state_part[0], excited))

    return F, operator, reaction


def stationary_world(problem: PerformativeProblem, reacting: Array) -> StationaryWorld:
    """The world under the lifted deployed policy `reacting`."""
    n = problem.state_size
    loop = closed_loop(problem, reacting)
    F, operator, reaction = _second_moments(loop)
    Q, R = loop.on_x, loop.on_v
    N = jnp.zeros((problem.input_size, n), Q.dtype) if loop.between is None else loop.between
    noise = problem.noise_under(reacting)
    right = jnp.stack([symmetrise(Q), jnp.eye(n, dtype=Q.dtype)])
    Lambda, from_identity = solve_fixed_point(operator, right)
    Lambda = jnp.where(is_stable(from_identity), Lambda, jnp.nan)
    excited = reaction(Lambda)
    if loop.state_part is None:
        return StationaryWorld(Lambda, Q + excited, N, R, F, _constant(loop.B), noise.mean, noise.covariance)
    through = loop.state_part[0]
    Q, N, R = Q + congruence(through, excited), N + excited[n:] @ through, R + excited[n:, n:]
    return StationaryWorld(Lambda, Q, N, R, F, _constant(loop.B), noise.mean, noise.covariance)


def mean_stage(problem: PerformativeProblem, world: StationaryWorld, v: Array) -> tuple[Array, Array]:
    """What the means cost per stage under a constant feedforward v (m,), and the gradient by v."""
    n = problem.state_size
    cost = problem.cost
    assert isinstance(cost, QuadraticCost)
    linear, constant = cost.linear_terms(0)
    by_input = linear[0, n:]
    by_state = linear[0, :n] - by_input @ problem.gain
    x = world.settled(matvec(world.B, v) + world.noise_mean)
    on_x = world.Q @ x + v @ world.N + by_state
    on_v = world.N @ x + world.R @ v + by_input
    total = x @ (on_x + by_state) + v @ (on_v + by_input) + constant[0]
    pulled = jnp.linalg.solve(jnp.eye(n, dtype=v.dtype) - as_dense(world.F).T, on_x)
    return total, 2 * (on_v + rmatvec(world.B, pulled))


@program
def mean_square_radius(problem: PerformativeProblem, deployed: Any) -> Array:
    """ρ(𝒯) of the world that the deployed policy's free parameters make: it is mean-square stable below 1."""
    _, operator, _ = _second_moments(closed_loop(problem, problem.structure.lift(deployed)))
    return spectral_radius(operator, problem.state_size, problem.dtype)
