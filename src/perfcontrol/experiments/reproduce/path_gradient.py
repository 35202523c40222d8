"""The gradient along a simulated path, stock by stock: that of `pc.Pathwise` with the same key, in a third of the time.

Stock l has the state [r; q] and meets the row m of M and the row d of the deployed policy: with ω_t the risk of the day
less its mean where r meets it, δ what the noise of q has more, φ_t = ρ - 1 + E e_t Σ d/exposure and
ν_t = (e_t - E e_t)·d/exposure

    r_{t+1} = φ_t r_t + ν_t q_t + ω_t + m·ω_{t-1},        q_{t+1} = φ_t q_t + ν_t q_t + the same + δ + m·δ,

without the terms in m at t = 0. With y and z the adjoints of r and q, and s = y + z

    s_t = φ_t s_{t+1} + ν_t s_{t+1} + 2 r_t,    z_t = φ_t z_{t+1} + ν_t s_{t+1},
    ∇_m = Σ_{t≥1} (2 m·ω_{t-1} + s_{t+1}) ω_{t-1} + z_{t+1} δ,

both being the recursion X_{t+1} = φ_t X_t + ν_t (X_t)₁ + f_t of a pair. Runs stand side by side in memory
(`_side_by_side`), so many of them that the compiler makes vectors of everything.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from perfcontrol._checks import fail
from perfcontrol._side_by_side import side_by_side
from perfcontrol.perturbations import StockPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_keys import unit_numbers
from perfcontrol.random_vectors import Linear, StochasticVolatility, Uniform
from perfcontrol.random_vectors.stochastic_volatility import price_ratios
from perfcontrol.solvers.gradients import AbstractGradient


class Market(NamedTuple):
    """The numbers of a stock market, those of several along a last axis."""

    persistence: Array  # ρ
    exposure: Array
    capital: Array  # q_0
    rate: Array
    log_sensitivity: Array  # (T,)
    mean_growth: Array  # (T,)
    low: Array  # (L,): the risk is uniform from here
    high: Array  # (L,)
    shift: Array  # (2L,): what the noise adds to it


class StockByStock(AbstractGradient):
    """`pc.Pathwise()` for the problems of `stock_market`, from the same random numbers."""

    @property
    def lanes(self) -> int:
        return 48  # of 16, 32, 48, 64 the fastest but for one per cent

    def check(self, problem: PerformativeProblem) -> None:
        law, noise = problem.perturbation, problem.noise
        growth = law.growth if isinstance(law, StockPerturbation) else None
        risk = noise.law if isinstance(noise, Linear) else None
        if not (isinstance(growth, StochasticVolatility) and isinstance(risk, Uniform)):
            raise fail("gradient", type(self).__name__, "belong to a stock market", "Pass gradient=pc.Pathwise().")

    def __call__(
        self, problem: PerformativeProblem, M: Array, deployed: Array, key: Key[Array, ""], batch: int
    ) -> Array:
        law: Any = problem.perturbation
        noise: Any = problem.noise
        persistence: Any = problem.system.A
        market = Market(
            persistence.values[0],
            law.exposure,
            problem.initial_state.mean[M.shape[-1]],
            law.growth.rate,
            law.growth.log_sensitivity,
            law.growth.first_moment,
            noise.law.low,
            noise.law.high,
            noise.offset,
        )

        def of_paths(market: Market, M: Array, deployed: Array, key: Array) -> Array:
            if key.ndim:
                return _gradient(market, M, deployed, key, law.growth.volatility)
            market, M, deployed, key = jax.tree.map(lambda leaf: leaf[..., None], (market, M, deployed, key))
            return _gradient(market, M, deployed, key, law.growth.volatility)[..., 0]

        one = side_by_side(of_paths)
        if batch == 1:
            return one(market, M[0], deployed[0], key)[None]
        paths = jax.lax.map(lambda s: one(market, M[0], deployed[0], jax.random.fold_in(key, s)), jnp.arange(batch))
        return jnp.mean(paths, axis=0)[None]


def _gradient(market: Market, M: Array, deployed: Array, keys: Key[Array, " runs"], volatility: str) -> Array:
    """∇_m of every stock, (L, L, runs), for policies (L, L, runs); a last axis of length 1 is shared."""
    T, L, runs = len(market.mean_growth), len(M), len(keys)
    market, M, deployed = _written(runs, (market, M, deployed))
    M, deployed = (jnp.broadcast_to(policy, (L, L, runs)) for policy in (M, deployed))
    # The keys that `pc.sample_path` makes of a path's: of its noise and of its perturbations. What a loop, here of two
    # rounds, works on is written down; elsewhere the compiler would make keys anew for every number.
    _, noise_key, growth_key = jnp.moveaxis(jax.vmap(lambda key: jax.random.split(key, 3))(keys), 1, 0)
    unit = jax.lax.map(lambda keys: unit_numbers(keys, T * L, M.dtype), jnp.stack([noise_key, growth_key]))
    unit = unit.reshape(2, T, L, runs)
    risk = unit[0] * (market.high - market.low) + (market.low + market.shift[:L])
    ratios = price_ratios(unit[1], market.log_sensitivity[:, None], market.rate, T, volatility)
    growth = (ratios - market.mean_growth[:, None]) / market.exposure
    total = jnp.sum(deployed, axis=1) / market.exposure
    phi = market.persistence - 1 + market.mean_growth[:, None] * total
    answer, nu = _rows_times(M, risk), _rows_times(deployed, growth)
    more = jnp.broadcast_to(market.shift[L:] - market.shift[:L], (L, runs))
    moved = jnp.sum(M * more, axis=1)
    start = jnp.stack([nu[0] * market.capital + risk[0], (phi[0] + nu[0]) * market.capital + risk[0] + more])
    steady = _flat(jnp.stack([jnp.zeros_like(more), more + moved]))
    met, last = _pairs(phi[1:], nu[1:], risk[1:] + answer[:-1], lambda common: common + steady, start)
    second = jnp.arange(2, dtype=M.dtype)[:, None]
    end = second[..., None] * (2 * last[0])
    adjoints, _ = _pairs(phi[1:], nu[1:], met, lambda pair: second * (2 * pair[0]), end, reverse=True)

    weights = 2 * answer + jnp.concatenate([adjoints[:, 1], jnp.zeros_like(answer[:1])])
    by_risk = jnp.einsum("tlz,tkz->lkz", weights, risk, precision="highest")
    return by_risk + jnp.sum(adjoints[:, 0], axis=0)[:, None] * more


def _written(runs: int, tree: Any) -> Any:
    """The same numbers, all of them finite, those of all runs side by side in memory."""

    def written(leaf: Array) -> Array:
        # A product with the identity: a mere transpose the compiler leaves out, to read numbers where they lie.
        if leaf.shape[-1] == 1:
            return leaf
        return jnp.einsum("...k,kz->...z", leaf, jnp.eye(runs, dtype=leaf.dtype), precision="highest")

    return jax.tree.map(written, tree)


def _rows_times(matrix: Array, vectors: Array) -> Array:
    """The product of (L, L, runs) with each of (T, L, runs)."""
    return sum(matrix[:, k] * vectors[:, None, k] for k in range(len(matrix)))  # type: ignore[return-value]


def _pairs(
    phi: Array, nu: Array, feed: Array, feeding: Callable[[Array], Array], start: Array, reverse: bool = False
) -> tuple[Array, Array]:
    """X_{t+1} = φ_t X_t + ν_t (X_t)₁ + feeding(f_t) from X_1 = `start`, (2, L, runs): all but the last; the last."""

    def step(X: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        phi, nu, feed = map(_flat, now)
        return phi * X + nu * X[1] + feeding(feed), X

    last, before = jax.lax.scan(step, _flat(start), (phi, nu, feed), reverse=reverse)
    return before.reshape(-1, *start.shape), last.reshape(start.shape)


def _flat(numbers: Array) -> Array:
    """One long last axis, for vectors to be made of."""
    return numbers.reshape(*numbers.shape[:-2], -1)
