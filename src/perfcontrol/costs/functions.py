"""Ready-made functions for `ConvexCost`, entry by entry: each nears a weighted sum of squares in one of its limits.

All are Σ_i q_i h(x_i - x*_i) + Σ_j r_j k(u_j - u*_j), without a factor one half; `ConvexCost` learns their constants.
"""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from perfcontrol._checks import as_array, check_nonnegative, fail, is_concrete


class AbstractStageFunction(eqx.Module):
    """Σ_i q_i h(x_i - x*_i) + Σ_j r_j k(u_j - u*_j), with h and k convex and at most as curved as a square."""

    state_weight: Array
    input_weight: Array
    state_target: Array | None
    input_target: Array | None

    def __init__(self, state_weight: Any, input_weight: Any, state_target: Any, input_target: Any):
        self.state_weight = as_array("state_weight", state_weight)
        self.input_weight = as_array("input_weight", input_weight)
        for name, weight in (("state_weight", self.state_weight), ("input_weight", self.input_weight)):
            if weight.ndim > 1:
                raise fail(
                    name,
                    f"{weight.shape}",
                    "be a number or a vector",
                    "Pass one weight an entry: the diagonal of a matrix.",
                )
            check_nonnegative(name, weight, "The stage cost must be convex.")
        self.state_target = None if state_target is None else as_array("state_target", state_target)
        self.input_target = None if input_target is None else as_array("input_target", input_target)

    @abc.abstractmethod
    def of_state(self, z: Array) -> Array:
        """h, entry by entry."""

    def of_input(self, z: Array) -> Array:
        """k, entry by entry: the square unless a function says otherwise."""
        return z**2

    def __call__(self, t: Any, x: Float[Array, " n"], u: Float[Array, " m"]) -> Array:
        x = x if self.state_target is None else x - self.state_target
        u = u if self.input_target is None else u - self.input_target
        return jnp.sum(self.state_weight * self.of_state(x)) + jnp.sum(self.input_weight * self.of_input(u))

    @property
    def strong_convexity(self) -> Array:
        """μ on the whole space: none of these functions has any far out."""
        return jnp.zeros(())

    @property
    def smoothness(self) -> Array | None:
        """ς: that of the squares."""
        return 2 * jnp.maximum(jnp.max(self.state_weight), jnp.max(self.input_weight))

    @property
    def gradient_bound(self) -> Array | None:
        """G: that of the squares; None where targets shift them."""
        return self.smoothness if self.state_target is None and self.input_target is None else None


def _positive(name: str, value: Any) -> Array:
    number = as_array(name, value)
    if number.ndim or (is_concrete(number) and not float(number) > 0):
        raise fail(
            name,
            f"{value}",
            "be one positive number",
            "Pass for example 1.0: a large one nears the square, and weights scale entries.",
        )
    return number


class Huber(AbstractStageFunction):
    """Huber's function of states and inputs: z² up to the threshold, threshold·(2|z| - threshold) beyond.

    Args:
        threshold: a positive number.
        state_weight: q, nonnegative, a number or (n,).
        input_weight: r, nonnegative, a number or (m,).
        state_target: x*, a number or (n,); None for zero.
        input_target: u*, a number or (m,); None for zero.

    Raises:
        InputError: a threshold that is not positive, negative weights.

    References:
        Huber (1964).
    """

    threshold: Array

    def __init__(
        self,
        threshold: Any,
        state_weight: Any = 1.0,
        input_weight: Any = 1.0,
        state_target: Any = None,
        input_target: Any = None,
    ):
        self.threshold = _positive("threshold", threshold)
        super().__init__(state_weight, input_weight, state_target, input_target)

    def of_state(self, z: Array) -> Array:
        inner = jnp.clip(z, -self.threshold, self.threshold)
        return inner * (2 * z - inner)

    def of_input(self, z: Array) -> Array:
        return self.of_state(z)


class LogCosh(AbstractStageFunction):
    """A smooth absolute value of states and inputs: 2 scale² log cosh(z / scale), near z² where |z| is small.

    Args:
        scale: a positive number; beyond it the function grows like 2·scale·|z|.
        state_weight: q, nonnegative, a number or (n,).
        input_weight: r, nonnegative, a number or (m,).
        state_target: x*, a number or (n,); None for zero.
        input_target: u*, a number or (m,); None for zero.

    Raises:
        InputError: a scale that is not positive, negative weights.
    """

    scale: Array

    def __init__(
        self,
        scale: Any,
        state_weight: Any = 1.0,
        input_weight: Any = 1.0,
        state_target: Any = None,
        input_target: Any = None,
    ):
        self.scale = _positive("scale", scale)
        super().__init__(state_weight, input_weight, state_target, input_target)

    def of_state(self, z: Array) -> Array:
        # One branch loses digits near zero, the other overflows far out.
        y = z / self.scale
        small = jnp.abs(y) < 1
        near, far = jnp.where(small, y, 0), jnp.where(small, 1, jnp.abs(y))
        log_cosh = jnp.where(small, jnp.log1p(jnp.sinh(near) ** 2) / 2, far + jnp.log1p(jnp.exp(-2 * far)) - jnp.log(2))
        return 2 * self.scale**2 * log_cosh

    def of_input(self, z: Array) -> Array:
        return self.of_state(z)


class OneSidedQuadratic(AbstractStageFunction):
    """max(±z, 0)² of the states, z² of the inputs: what lies on the other side of the target costs nothing.

    Args:
        side: "above" (states beyond their target cost) or "below".
        state_weight: q, nonnegative, a number or (n,).
        input_weight: r, nonnegative, a number or (m,).
        state_target: x*, a number or (n,); None for zero.
        input_target: u*, a number or (m,); None for zero.

    Raises:
        InputError: another side, negative weights.
    """

    side: str = eqx.field(static=True)

    def __init__(
        self,
        side: str = "above",
        state_weight: Any = 1.0,
        input_weight: Any = 1.0,
        state_target: Any = None,
        input_target: Any = None,
    ):
        if side not in ("above", "below"):
            raise fail("side", repr(side), 'be "above" or "below"', 'Pass side="above" where large values cost.')
        self.side = side
        super().__init__(state_weight, input_weight, state_target, input_target)

    def of_state(self, z: Array) -> Array:
        return jnp.maximum(z if self.side == "above" else -z, 0) ** 2


class LinearExponential(AbstractStageFunction):
    """Linear-exponential risk of the states, 2 (exp(risk·z) - 1 - risk·z) / risk², and z² of the inputs.

    Exponential on the side of the sign of `risk`, linear on the other; nears z² as risk → 0.

    Args:
        risk: not zero; a number, or (n,).
        state_weight: q, nonnegative, a number or (n,).
        input_weight: r, nonnegative, a number or (m,).
        state_target: x*, a number or (n,); None for zero.
        input_target: u*, a number or (m,); None for zero.

    Raises:
        InputError: a risk of zero, negative weights.

    References:
        Varian (1975), Zellner (1986).
    """

    risk: Array

    def __init__(
        self,
        risk: Any,
        state_weight: Any = 1.0,
        input_weight: Any = 1.0,
        state_target: Any = None,
        input_target: Any = None,
    ):
        self.risk = as_array("risk", risk)
        if self.risk.ndim > 1 or (is_concrete(self.risk) and not bool(jnp.all(self.risk != 0))):
            raise fail(
                "risk",
                f"{risk}",
                "not be zero: a number, or one a state",
                "Use pc.QuadraticCost: the limit of risk zero.",
            )
        super().__init__(state_weight, input_weight, state_target, input_target)

    def of_state(self, z: Array) -> Array:
        y = self.risk * z
        return 2 * (jnp.expm1(y) - y) / self.risk**2

    @property
    def smoothness(self) -> None:
        """ς: exponentials have none."""
        return None
