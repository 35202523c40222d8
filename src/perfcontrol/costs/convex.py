"""Any convex stage cost, given as a function: for simulation and stochastic gradients."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from perfcontrol._checks import as_array, fail, is_concrete
from perfcontrol._functions import as_callable, call
from perfcontrol.costs.base import AbstractCost, as_discount, check_discount, stage_factors
from perfcontrol.costs.convexity import check_convexity


class ConvexCost(AbstractCost):
    """c_t(x, u) = discount^t function(t, x, u), with gradients by automatic differentiation.

    Costs are simulated (`simulate`, `estimate_cost`, `sample_gradient`, `RSGD`); given a key, best responses, `RRM` and
    `StablePoint` are sampled, too, after a look at convexity, smoothness and constants on simulated paths
    (`check_convexity`). Elsewhere these are the user's word: theory takes them as declared.

    Args:
        function: (t, x, u) -> scalar, for an integer t = 0..T (traced), x (n,) and u (m,). A plain function is static;
            numbers to sweep belong in an eqx.Module or jax.tree_util.Partial. Ready-made: `Huber`, `LogCosh`,
            `OneSidedQuadratic`, `LinearExponential`. Constants that it knows as attributes need not be passed.
        strong_convexity: μ, jointly in x and u; None for unknown.
        smoothness: ς, the Lipschitz constant of the joint gradient, cross derivatives included; None for unknown.
        gradient_bound: G in ‖∇c_t‖ ≤ G D wherever ‖x‖, ‖u‖ ≤ D; None for unknown.
        discount: what a stage counts beside the one before it, in (0, 1]; the constants above are without it.

    Raises:
        InputError: no function, constants that are negative or contradict each other, or (when the problem is built)
            a function that does not fit.

    References:
        Assumptions A4 (strong convexity), A5 (smoothness) and A6 (gradients).
    """

    function: Callable
    strong_convexity: Array | None
    smoothness: Array | None
    gradient_bound: Array | None
    discount: Array | None  # None: 1

    def __init__(
        self,
        function: Any,
        strong_convexity: Any = None,
        smoothness: Any = None,
        gradient_bound: Any = None,
        discount: Any = 1.0,
    ):
        self.discount = as_discount(discount)
        self.function = as_callable("function", function)

        def constant(name: str, value: Any) -> Array | None:
            return _constant(name, getattr(self.function, name, None) if value is None else value)

        self.strong_convexity = constant("strong_convexity", strong_convexity)
        self.smoothness = constant("smoothness", smoothness)
        self.gradient_bound = constant("gradient_bound", gradient_bound)
        mu, sigma = self.strong_convexity, self.smoothness
        if mu is not None and sigma is not None and is_concrete(mu) and is_concrete(sigma) and float(mu) > float(sigma):
            raise fail(
                "strong_convexity",
                f"{float(mu)}",
                f"not exceed the smoothness {float(sigma)}",
                "Lower it, or raise smoothness: no function curves more than its gradient allows.",
            )

    def check(self, state_size: int, input_size: int, horizon: int | float) -> None:
        check_discount(self.discount, horizon)
        dtype = jnp.result_type(float)
        t = jax.ShapeDtypeStruct((), jnp.result_type(int))
        x, u = jax.ShapeDtypeStruct((state_size,), dtype), jax.ShapeDtypeStruct((input_size,), dtype)
        value = jax.eval_shape(self._stage, t, x, u)
        if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
            got = f"{value.dtype} of shape {value.shape}"
            raise fail(
                "function", got, "return one real number", "Return a scalar: sum over the components of x and u."
            )

    def check_convexity(self, x: Float[Array, "S T1 n"], u: Float[Array, "S T1 m"]) -> None:
        """Raise InputError where the function is not convex, not smooth, or breaks a declared constant.

        Looked at: points of given paths, and others up to twice as far out. What holds there is not proved elsewhere.
        """
        count, length = x.shape[:2]
        z = np.concatenate([np.asarray(x), np.asarray(u)], axis=2)
        spread = np.sqrt(np.mean(z**2, axis=(0, 1)))
        beyond = np.random.default_rng(0).normal(size=z.shape) * 2 * np.where(spread > 0, spread, 1)
        points = np.concatenate([z, beyond.astype(z.dtype)]).transpose(1, 0, 2).reshape(-1, z.shape[2])
        constants = {"strong_convexity": self.strong_convexity, "smoothness": self.smoothness}
        times = np.repeat(np.arange(length), 2 * count)
        check_convexity(self.function, constants, times, points[:, : x.shape[2]], points[:, x.shape[2] :])

    def _stage(self, t: Array, x: Array, u: Array) -> Array:
        return call("function", lambda t, x, u: jnp.asarray(self.function(t, x, u)), t=t, x=x, u=u)

    def _slopes(self, t: Array, x: Array, u: Array) -> tuple[Array, Array]:
        return call("function", jax.grad(self.function, argnums=(1, 2)), t=t, x=x, u=u)

    def _times(self, x: Array) -> Array:
        return jnp.arange(x.shape[0])

    def path_cost(self, x: Array, u: Array) -> Array:
        return self._discounted(jax.vmap(self._stage)(self._times(x), x, u))

    def path_gradients(self, x: Array, u: Array) -> tuple[Array, Array]:
        by_state, by_input = jax.vmap(self._slopes)(self._times(x), x, u)
        return self._discounted(by_state), self._discounted(by_input)

    def _discounted(self, values: Array) -> Array:
        if self.discount is None:
            return values
        factors = stage_factors(self.discount, len(values)).astype(values.dtype)
        return factors.reshape(-1, *[1] * (values.ndim - 1)) * values


def _constant(name: str, value: Any) -> Array | None:
    if value is None:
        return None
    number = as_array(name, value)
    if number.ndim or (is_concrete(number) and float(number) < 0):
        raise fail(name, str(value), "be a nonnegative number", "Pass None where it is not known.")
    return number
