"""Exact cost and gradient of a policy for quadratic stage costs, without sampling: the cost-to-go form.

The closed loop does not depend on M, so neither does the cost-to-go. Backward in time, on z = [x; u],

    Γ_t = C_t + Ā_tᵀ Λ_{t+1} Ā_t + 𝒞_t*[Λ_{t+1}],     Ā_t = [A_t, B_t] + Θ_t,
    [[Λ_t, D_tᵀ], [D_t, S_t]] = Γ_t seen through u = v - K_t x,

where C_t is the stage weight, Θ_t = E Δ_t and 𝒞_t*[X] = E (Δ-Θ)ᵀX(Δ-Θ). An impulse w_s then costs a quadratic
form in [I; M̂] with blocks S and D F⋯F B (`ImpulseForm`), the deterministic means cost what one mean path costs
(`mean_path`), and the covariance of x_0 costs tr Λ_0 Cov(x_0). Nothing is quadratic in the horizon.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._checks import check_finite, fail
from perfcontrol._linalg import Matrix, along_time, as_dense, congruence, matvec, rmatvec, symmetrise, transpose
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.rollout import check_pair, input_adjoint, input_term
from perfcontrol.perturbations import CovarianceOperator
from perfcontrol.policy import feedforward, feedforward_adjoint
from perfcontrol.problem import PerformativeProblem

SIMULATE = "Use pc.estimate_cost and pc.sample_gradient, which only simulate."


class CostToGo(eqx.Module):
    """What the deployed policy makes of the world; none of it depends on the evaluated policy.

    Lambda: (T+1, n, n) cost-to-go. S: (T+1, m, m) curvature in the feedforward v_t. D: (T+1, m, n) its coupling to
    the state. R, N: the parts of S and D that are not BᵀΛB and BᵀΛF: stage cost and perturbation of the input; with
    the axis T+1 where they vary, N None where there is no coupling. F: (n, n) mean closed loop, B: (n, m) mean input
    matrix, Θ included; with the axis T where they vary. noise_mean: (n,) or (T, n) and noise_covariance: (n, n) or
    (T, n, n), of the law of w_t.
    """

    Lambda: Float[Array, "T1 n n"]
    R: Float[Array, "*steps m m"]
    N: Float[Array, "*steps m n"] | None
    S: Float[Array, "T1 m m"]
    D: Float[Array, "T1 m n"]
    F: Matrix
    B: Matrix
    noise_mean: Float[Array, "*time n"]
    noise_covariance: Float[Array, "*times n n"]


class ImpulseForm(eqx.Module):
    """Σ_s of the quadratic forms that impulses w_s meet, for noise whose covariance is constant.

    G: (H m, H m), F: (H m, n), a: (n, n): cost tr Σ (a + FᵀM̂ + M̂ᵀF + M̂ᵀG M̂), M̂ the (H m, n) stack of lags.
    """

    G: Float[Array, "Hm Hm"]
    F: Float[Array, "Hm n"]
    a: Float[Array, "n n"]


def require_moments(problem: PerformativeProblem) -> None:
    """Raise unless the cost is what exact evaluation needs; of the perturbation, `known_covariance` says."""
    if not isinstance(problem.cost, QuadraticCost):
        raise fail("cost", type(problem.cost).__name__, "be a QuadraticCost for exact evaluation", SIMULATE)


def known_covariance(problem: PerformativeProblem, reacting: Array) -> CovarianceOperator:
    """The covariance operator of the perturbation; raises where the law does not know it."""
    spread = problem.perturbation.covariance(reacting, problem.horizon)
    if spread is None:
        raise fail(
            "perturbation",
            f"{type(problem.perturbation).__name__} without known moments",
            "know its mean and covariance for exact evaluation",
            SIMULATE,
        )
    return spread


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


def _stage_weights(problem: PerformativeProblem) -> tuple[Array, Array | None, Array]:
    """The stage weight seen through u = v - K x: on x, (n, n); between v and x, (m, n), None for zero; on v, (m, m).

    Each with a leading axis T+1 where it varies in time.
    """
    cost = problem.cost
    assert isinstance(cost, QuadraticCost)
    Q, R, cross = cost.Q, cost.R, cost.cross
    between = None if cross is None else transpose(cross)
    if not problem.has_gain:
        return Q, between, R
    K = problem.gain
    on_x = Q + transpose(K) @ R @ K
    if between is None:
        return on_x, -R @ K, R
    mixed = transpose(K) @ between
    return on_x - mixed - transpose(mixed), between - R @ K, R


def cost_to_go(problem: PerformativeProblem, reacting: Array) -> CostToGo:
    """The backward recursion under the lifted deployed policy `reacting`."""
    n, m, T = problem.state_size, problem.input_size, problem.horizon
    on_x, between, on_v = _stage_weights(problem)
    A, B = problem.system.A, problem.system.B
    on_input = problem.perturbation.columns(n, m) > n
    Theta = problem.perturbation.mean_operator(reacting, T)
    if Theta is not None and on_input:
        joint = as_dense(Theta)
        A, B = A + joint[..., :n], B + joint[..., n:]
    elif Theta is not None:
        A = A + Theta
    F = problem.closed_loop(A, B)
    varying = F.ndim == 3
    spread = known_covariance(problem, reacting)
    K = problem.gains()[:-1]
    state_part = jnp.concatenate([jnp.broadcast_to(jnp.eye(n, dtype=K.dtype), (T, n, n)), -K], axis=1)

    spread_steps, backward = (spread.steps, None) if varying or on_input else spread.backward(F)

    def retreat(Lambda: Array, step: Any) -> tuple[Array, Array]:
        F_t, stage_t, spread_t, state_part_t = step
        if backward is not None:
            moved = backward(spread_t, Lambda)
        else:
            reaction = spread.adjoint_step(spread_t, Lambda)
            moved = congruence(F_t if varying else F, Lambda)
            moved = moved + (congruence(state_part_t, reaction) if on_input else reaction)
        previous = (on_x if stage_t is None else stage_t) + moved
        return previous, previous

    last = symmetrise(on_x if on_x.ndim == 2 else on_x[-1])
    stages = on_x[:-1] if on_x.ndim == 3 else None
    steps = (F if varying else None, stages, spread_steps, state_part if on_input else None)
    _, earlier = jax.lax.scan(retreat, last, steps, reverse=True)
    Lambda = jnp.concatenate([earlier, last[None]])
    if on_input:
        reaction = spread.adjoint(Lambda[1:])[:, n:, :]
        last_stage = ((0, 1), (0, 0), (0, 0))  # nothing reacts after it
        on_v = on_v + jnp.pad(reaction[:, :, n:], last_stage)
        between = jnp.pad(reaction @ state_part, last_stage) + (0 if between is None else between)
    # What couples to v needs no recursion: in bulk over time.
    pulled = transpose(Lambda[1:] @ B)

    def with_stage(stage: Array | None, moved: Array) -> Array:
        if stage is None:
            return jnp.pad(moved, ((0, 1), (0, 0), (0, 0)))
        stages: Array = along_time(stage, 2, T + 1)
        return jnp.concatenate([stages[:-1] + moved, stages[-1:]])

    S, D = with_stage(on_v, pulled @ B), with_stage(between, pulled @ F)
    noise = problem.noise_under(reacting)
    return CostToGo(Lambda, on_v, between, S, D, F, B, noise.mean, noise.covariance)


def _chains(world: CostToGo, memory: int) -> tuple[list[Array], list[Array]]:
    """Y[d]_t = D_t F_{t-1} ⋯ F_{t-d}, (H, T+1, m, n), and X[d]_t, the block coupling lags j and j-d at t = s+j.

    X[0] = S and X[d] = Y[d-1]_t B_{t-d}, (H, T+1, m, m); zero where t < d.
    """
    length = world.S.shape[0]

    def shifted(matrices: Matrix, d: int) -> Matrix:
        """matrices_{t-d} for t = 0..T, zero where t < d."""

        def shift(array: Array) -> Array:
            return jnp.concatenate([jnp.zeros((d, *array.shape[1:]), array.dtype), array])[:length]

        return jax.tree.map(shift, along_time(matrices, 2, length - 1))

    Y, X = [world.D], [world.S]
    for d in range(1, memory):
        X.append(Y[-1] @ shifted(world.B, d))
        Y.append(Y[-1] @ shifted(world.F, d))
    return Y, X


def tail_sums(matrices: Array, memory: int, length: int) -> Array:
    """Σ_{t ≥ j} of matrices_t for j = 1..memory, t up to length - 1; without a time axis, the same at every t."""
    if matrices.ndim == 2:
        return jnp.arange(length - 1, length - 1 - memory, -1, dtype=matrices.dtype)[:, None, None] * matrices
    parts = jnp.concatenate([matrices[1:memory], jnp.sum(matrices[memory:], axis=0)[None]])
    return jnp.flip(jnp.cumsum(jnp.flip(parts, axis=0), axis=0), axis=0)


def _chain_tails(world: CostToGo, memory: int) -> tuple[Array, Array]:
    """Σ_{t ≥ j} X[d]_t at index [d, j-1], (H, H, m, m), and Σ_{t > d} Y[d]_t, (H, m, n)."""
    length = world.S.shape[0]
    if world.F.ndim == 3 or world.B.ndim == 3:
        Y, X = _chains(world, memory)
        # Y[d]_t is zero for t < d, and t = d would be the impulse w_{-1}.
        over_time = jnp.stack([jnp.sum(y[d + 1 :], axis=0) for d, y in enumerate(Y)])
        return jnp.stack([tail_sums(x, memory, length) for x in X]), over_time
    # The same matrices at every time: the sums come first, and nothing but Λ needs a pass over time.
    F, B = as_dense(world.F), as_dense(world.B)
    pulled = transpose(B) @ tail_sums(world.Lambda[1:], memory, length - 1)
    curvature = pulled @ B + tail_sums(world.R, memory, length)
    coupling = pulled @ F if world.N is None else pulled @ F + tail_sums(world.N, memory, length)
    Y, X = [coupling], [curvature]
    for _ in range(1, memory):
        X.append(Y[-1] @ B)
        Y.append(Y[-1] @ F)
    return jnp.stack(X), jnp.stack([y[d] for d, y in enumerate(Y)])


def impulse_form(world: CostToGo, memory: int) -> ImpulseForm:
    """The blocks summed over impulses, by tail sums over time."""
    m = world.S.shape[-1]
    X, Y = _chain_tails(world, memory)
    row, column = jnp.meshgrid(jnp.arange(memory), jnp.arange(memory), indexing="ij")
    blocks = X[jnp.abs(row - column), jnp.maximum(row, column)]
    blocks = jnp.where((row >= column)[..., None, None], blocks, transpose(blocks))
    G = blocks.transpose(0, 2, 1, 3).reshape(memory * m, memory * m)
    return ImpulseForm(G, Y.reshape(memory * m, -1), jnp.sum(world.Lambda[1:], axis=0))


def sustained_form(world: CostToGo, memory: int) -> Array:
    """(H m, H m): the quadratic form that constant feedforwards ṽ_i, held from time i on, meet (i = 1..H)."""
    length, m = world.S.shape[0], world.S.shape[-1]
    active = (jnp.arange(length)[:, None] >= jnp.arange(1, memory + 1)).astype(world.S.dtype)  # (T+1, H)
    B = as_dense(along_time(world.B, 2, length - 1))
    push = (B[:, :, None, :] * active[:-1, None, :, None]).reshape(length - 1, B.shape[1], memory * m)
    varying = world.F.ndim == 3

    def advance(X: Array, step: Any) -> tuple[Array, Array]:
        F_t, push_t = step
        return (F_t if varying else world.F) @ X + push_t, X

    last, X = jax.lax.scan(advance, jnp.zeros_like(push[0]), (world.F if varying else None, push))
    states = jnp.concatenate([X, last[None]])  # X_t: the state that the columns of ṽ have led to
    coupled = tail_sums(world.D @ states, memory, length).reshape(memory * m, memory * m)
    held = tail_sums(world.S, memory, length)[jnp.maximum(*jnp.indices((memory, memory)))]
    return coupled + coupled.T + held.transpose(0, 2, 1, 3).reshape(memory * m, memory * m)


def _varying_impulses(world: CostToGo, M: Array, covariance: Array) -> tuple[Array, Array]:
    """Cost and gradient (H, m, n) of the impulses where the noise covariance (T, n, n) varies in time."""
    memory = M.shape[0]
    T = covariance.shape[0]
    Y, X = _chains(world, memory)

    def spread(array: Array, j: int) -> Array:
        """array_{s+j} for s = 0..T-1, zero past T."""
        pad = jnp.zeros((memory, *array.shape[1:]), array.dtype)
        return jnp.concatenate([array, pad])[j : j + T]

    fed = [M[i] @ covariance for i in range(memory)]  # M_i Σ_s
    linear = [jnp.einsum("tmn,tnk->mk", spread(Y[j - 1], j), covariance) for j in range(1, memory + 1)]
    curved = [jnp.zeros_like(M[0]) for _ in range(memory)]
    for j in range(1, memory + 1):
        for d in range(j):
            block = spread(X[d], j)
            curved[j - 1] += jnp.einsum("tab,tbn->an", block, fed[j - 1 - d])
            if d:
                curved[j - 1 - d] += jnp.einsum("tba,tbn->an", block, fed[j - 1])
    linear_all, curved_all = jnp.stack(linear), jnp.stack(curved)
    constant = jnp.einsum("tij,tji->", world.Lambda[1:], covariance)
    return constant + jnp.sum(M * (2 * linear_all + curved_all)), 2 * (linear_all + curved_all)


def _constant_impulses(world: CostToGo, M: Array, covariance: Array) -> tuple[Array, Array]:
    """Cost and gradient (H, m, n) of the impulses where the noise covariance (n, n) is constant."""
    form = impulse_form(world, M.shape[0])
    stacked = M.reshape(-1, M.shape[-1])
    curved = form.G @ stacked
    cost = jnp.sum(covariance * (form.a + transpose(stacked) @ (2 * form.F + curved)))
    return cost, (2 * (form.F + curved) @ covariance).reshape(M.shape)


def mean_path(problem: PerformativeProblem, world: CostToGo, v: Array, w: Array, x0: Array) -> tuple[Array, Array]:
    """Expected cost of the deterministic part v (T+1, m), w (T, n), x_0, and its gradient by v, (T+1, m).

    The multiplicative noise that the mean path excites is included: Λ carries it.
    """
    n, T = problem.state_size, problem.horizon
    cost = problem.cost
    assert isinstance(cost, QuadraticCost)
    push = input_term(world.B, v) + w
    moved = matvec(world.Lambda[1:], push)
    source, by_input_stage, constant = jnp.zeros((T + 1, n), v.dtype), 0, 0
    if cost.has_targets:
        linear, constant = cost.linear_terms(T)
        by_input_stage = linear[:, n:]
        source = linear[:, :n] - problem.feedback_adjoint(by_input_stage)
    if world.N is not None:
        source = source + (v @ world.N if world.N.ndim == 2 else rmatvec(world.N, v))
    varying = world.F.ndim == 3
    F = world.F if varying else None

    def retreat(p: Array, step: Any) -> tuple[Array, Array]:
        F_t, source_t, moved_t = step
        return source_t + rmatvec(F_t if varying else world.F, moved_t + p), p

    p0, p_next = jax.lax.scan(retreat, source[-1], (F, source[:-1], moved), reverse=True)

    def advance(mu: Array, step: Any) -> tuple[Array, Array]:
        F_t, push_t = step
        following = matvec(F_t if varying else world.F, mu) + push_t
        return following, following

    _, mu = jax.lax.scan(advance, x0, (F, push))
    # x' Λ x + 2 p' x is what lies ahead: each push adds its own to it, and by_v is what it adds at the margin.
    total = x0 @ (world.Lambda[0] @ x0 + 2 * p0) + jnp.sum(push * (moved + 2 * p_next)) + jnp.sum(constant)
    weighed = v @ world.R if world.R.ndim == 2 else matvec(world.R, v)
    total = total + jnp.sum(v * (weighed + 2 * by_input_stage))
    margin = input_adjoint(world.B, matvec(world.Lambda[1:], mu) + p_next)
    by_v = weighed + by_input_stage + jnp.pad(margin, ((0, 1), (0, 0)))
    if world.N is not None:
        states = jnp.concatenate([x0[None], mu])
        by_v = by_v + (states @ world.N.T if world.N.ndim == 2 else matvec(world.N, states))
    return total, 2 * by_v


def cost_and_gradient(problem: PerformativeProblem, world: CostToGo, policy: Array) -> tuple[Array, Array]:
    """C_T and ∇_1 C_T at a lifted policy, given the world that the deployed policy makes."""
    covariance, mean = world.noise_covariance, world.noise_mean
    impulses = _constant_impulses if covariance.ndim == 2 else _varying_impulses
    cost, gradient = impulses(world, policy, covariance)
    w = along_time(mean, 1, problem.horizon)
    deterministic, by_v = mean_path(problem, world, feedforward(policy, w), w, problem.initial_state.mean)
    start = jnp.sum(world.Lambda[0] * problem.initial_state.covariance)
    return cost + deterministic + start, gradient + feedforward_adjoint(by_v, w, problem.memory)


def exact_cost(problem: PerformativeProblem, M: Array, deployed: Array) -> Array:
    """C_T(M; deployed), free parameters; pure, differentiable in both."""
    return cost_and_gradient(problem, cost_to_go(problem, problem.structure.lift(deployed)), problem.structure.lift(M))[
        0
    ]


def exact_gradient(problem: PerformativeProblem, M: Array, deployed: Array) -> Array:
    """∇_1 C_T(M; deployed) in the free parameters; pure, differentiable in both."""
    world = cost_to_go(problem, problem.structure.lift(deployed))
    return problem.structure.adjoint(cost_and_gradient(problem, world, problem.structure.lift(M))[1])


_compiled_cost = eqx.filter_jit(exact_cost)
_compiled_gradient = eqx.filter_jit(exact_gradient)


@eqx.filter_jit
def _total_gradient(problem: PerformativeProblem, M: Array) -> Array:
    return jax.grad(lambda policy: exact_cost(problem, policy, policy))(M)


def expected_cost(problem: PerformativeProblem, M: Any, *, deployed: Any = None) -> Array:
    """Exact C_T(M; deployed) = E Σ_{t=0..T} c_t(x_t, u_t); `deployed=None` means M: the performative cost.

    Beware: `jax.grad(lambda M: expected_cost(problem, M))` differentiates in both policies, which is the gradient
    of the performative optimum, not the one that performative stability is about. See `expected_gradient`.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise; None for M itself.

    Returns:
        A scalar.

    Raises:
        InputError: wrong shapes, a cost or perturbation without closed moments.
    """
    M, reacting = check_pair(problem, M, deployed)
    require_moments(problem)
    return check_finite("the expected cost", _compiled_cost(problem, M, reacting))


def expected_gradient(problem: PerformativeProblem, M: Any, *, deployed: Any = None, total: bool = False) -> Array:
    """Exact ∇_1 C_T(M; deployed), the first argument alone; `total=True`: the derivative of C_T(M; M).

    A performatively stable policy has ∇_1 C_T(M; M) = 0 (or satisfies the variational inequality on the feasible
    set); a performatively optimal one has a zero total gradient.

    Returns:
        Shape `problem.policy_shape`.

    Raises:
        InputError: as `expected_cost`; `total=True` together with another deployed policy.
    """
    M, reacting = check_pair(problem, M, deployed)
    require_moments(problem)
    if not total:
        return check_finite("the expected gradient", _compiled_gradient(problem, M, reacting))
    if deployed is not None:
        raise fail(
            "deployed",
            "a policy together with total=True",
            "be left out for the total gradient",
            "The total derivative moves both policies together.",
        )
    return check_finite("the total gradient", _total_gradient(problem, M))
