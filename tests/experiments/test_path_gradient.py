"""The reproduction's gradient against the library's own, which works on every problem and shares no recursion."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.experiments.reproduce.path_gradient import StockByStock
from tests.tools import normal


def _market(order: Any = "random", **options: Any) -> pc.PerformativeProblem:
    return pc.experiments.stock_market(order, **{"growth": 0.97, "initial_investment": 120.0, "rate": 0.2} | options)


def _policies(count: int) -> jax.Array:
    return 0.05 + 0.02 * normal(0, count, 1, 10, 10)


@pytest.mark.parametrize(("make", "volatility"), [(pc.fast_key, "lognormal"), (jax.random.key, "as_printed")])
def test_gradient_is_that_of_paths_from_the_same_key(make: Any, volatility: str) -> None:
    """One run, and several side by side with markets, policies and keys of their own; one path, and the mean of two."""
    markets = [_market(growth=0.9 + 0.01 * i, initial_investment=100.0 + i, volatility=volatility) for i in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *markets)
    M, deployed = _policies(3), _policies(4)[1:]
    keys = jax.vmap(lambda n: jax.random.fold_in(make(2), n))(jnp.arange(3))

    def gradients(method: Any, *arguments: Any, axes: Any = 0) -> np.ndarray:
        one = jax.jit(jax.vmap(lambda *four: method(*four, 1), in_axes=axes))(*arguments)
        return np.asarray(one)

    expected = gradients(pc.Pathwise(), stacked, M, deployed, keys)
    np.testing.assert_allclose(gradients(StockByStock(), stacked, M, deployed, keys), expected, rtol=1e-10)
    alone = [StockByStock()(markets[i], M[i], deployed[i], keys[i], 1) for i in range(2)]
    np.testing.assert_allclose(alone, expected[:2], rtol=1e-10)
    if volatility == "lognormal":
        shared = gradients(StockByStock(), markets[0], M[0], deployed[0], keys, axes=(None, None, None, 0))
        np.testing.assert_allclose(
            shared,
            gradients(pc.Pathwise(), markets[0], M[0], deployed[0], keys, axes=(None, None, None, 0)),
            rtol=1e-10,
        )
        both = StockByStock()(markets[0], M[0], deployed[0], keys[0], 2)
        np.testing.assert_allclose(both, pc.Pathwise()(markets[0], M[0], deployed[0], keys[0], 2), rtol=1e-10)


def test_other_problems_are_refused() -> None:
    other = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5]], [[1.0]]),
        horizon=5,
        noise=pc.Gaussian([0.0], [[1.0]]),
        cost=pc.QuadraticCost([[1.0]], [[1.0]]),
    )
    solver = pc.RSGD(5, 0.1, gradient=StockByStock())
    with pytest.raises(pc.InputError, match="stock market"):
        pc.solve(other, solver, key=jax.random.key(0))
