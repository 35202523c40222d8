"""From a smooth stateful map to a linear system: its derivatives at an equilibrium, and how far they carry.

    Z_{t+1} = f(Z_t, θ_t)  ≈  A Z_t + B θ_t + w,     A = ∂f/∂Z,  B = ∂f/∂θ,  w = f(Z̄, θ̄) - A Z̄ - B θ̄,

or in deviations from the equilibrium, z = Z - Z̄ and u = θ - θ̄: z_{t+1} ≈ A z_t + B u_t + (f(Z̄, θ̄) - Z̄). Where the
map itself depends on the deployed policy, f(Z, θ, M), so do A, B and w: to first order by constant slopes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import as_array, check_integer, check_key, check_nonnegative, fail
from perfcontrol._functions import as_callable, call
from perfcontrol.policy_maps import Affine
from perfcontrol.systems.linear import LinearSystem

NEWTON_STEPS = 20  # towards an equilibrium, for the remedy of an error


@dataclass(frozen=True)
class LinearisationError:
    """How far a linearisation is from the map on a neighbourhood, over sampled points: lower estimates.

    Attributes:
        largest: of ‖f(Z, θ) - its linearisation‖.
        relative: of the same, divided by ‖(Z - Z̄, θ - θ̄)‖: compare with the size of [A, B].
    """

    largest: float
    relative: float


class Linearisation(eqx.Module):
    """A smooth map near an equilibrium.

    Attributes:
        f: the map.
        state: Z̄, (n,).
        input: θ̄, (m,).
        policy: M̄, the deployed policy that the map was differentiated at; None where it takes none.
        A: (n, n).
        B: (n, m).
        offset: w in absolute coordinates, (n,): the mean of the noise there.
        residual: f(Z̄, θ̄) - Z̄, (n,): the same in deviations, zero up to the tolerance.
        reaction: policy map M -> (n, n+m), the change of [A, B] to first order: the `mean` of a perturbation; None
            where the map takes no policy.
        offset_reaction: policy map M -> (n,), the change of `residual` to first order: add it to the noise's mean.
    """

    f: Any
    state: Array
    input: Array
    policy: Array | None
    A: Array
    B: Array
    offset: Array
    residual: Array
    reaction: Affine | None
    offset_reaction: Affine | None

    @property
    def system(self) -> LinearSystem:
        """A and B as a linear system, in deviations or in absolute coordinates."""
        return LinearSystem(self.A, self.B)

    def error(self, radius: Any, *, key: Any, samples: int = 1024) -> LinearisationError:
        """How far the linearisation is from the map on a ball around the equilibrium, or an ellipsoid.

        Half of the points lie on its surface, half inside; the policy stays the one of the linearisation.

        Args:
            radius: of the ball in (Z, θ), or (n+m,) half-axes where states and inputs have units of their own.
            key: JAX random key; required.
            samples: number of points.

        Returns:
            The largest errors over the points, by name `largest` and `relative`.
        """
        n, size = len(self.state), len(self.state) + len(self.input)
        axes = as_array("radius", radius)
        if axes.shape not in ((), (size,)) or float(jnp.min(axes)) <= 0:
            raise fail(
                "radius",
                f"{radius}",
                f"be positive, one number or {size}",
                "Pass one half-axis a state, then a half-axis an input.",
            )
        samples = check_integer("samples", samples, 2)
        direction_key, length_key = jax.random.split(check_key(key))
        directions = jax.random.normal(direction_key, (samples, size), self.A.dtype)
        directions = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
        inside = jax.random.uniform(length_key, (samples,), self.A.dtype) ** (1 / size)
        lengths = jnp.where(jnp.arange(samples) < samples // 2, 1.0, inside)
        steps = lengths[:, None] * directions * axes

        @jax.jit
        def gap(step: Array) -> Array:
            z, u = step[:n], step[n:]
            return (
                self._value(self.state + z, self.input + u)
                - self._value(self.state, self.input)
                - (self.A @ z + self.B @ u)
            )

        gaps = np.linalg.norm(np.asarray(jax.lax.map(gap, steps, batch_size=min(samples, 256))), axis=1)
        if not np.all(np.isfinite(gaps)):
            raise fail("radius", f"{radius}", "keep f finite", "Pass a smaller one.")
        return LinearisationError(float(gaps.max()), float((gaps / np.linalg.norm(np.asarray(steps), axis=1)).max()))

    def _value(self, state: Array, input: Array) -> Array:
        given = {"Z": state, "input": input} | ({} if self.policy is None else {"M": self.policy})
        return call("f", self.f, **given)


def linearise(f: Callable, state: Any, input: Any, policy: Any = None, tolerance: float | None = None) -> Linearisation:
    """Linearise a differentiable map at an equilibrium, by automatic differentiation.

    Examples:
        >>> import jax.numpy as jnp
        >>> pendulum = lambda x, u: x + 0.1 * jnp.array([x[1], -jnp.sin(x[0]) + u[0]])
        >>> near = linearise(pendulum, [0.0, 0.0], [0.0])
        >>> near.A.tolist(), near.B.tolist()
        ([[1.0, 0.1], [-0.1, 1.0]], [[0.0], [0.1]])

    Args:
        f: f(Z, θ) -> the next state (n,), or f(Z, θ, M) where the map depends on the deployed policy M; in jax.numpy.
        state: Z̄, (n,).
        input: θ̄, (m,).
        policy: M̄, the deployed policy (memory, m, n) at which the map is differentiated; None where f takes none.
        tolerance: how large ‖f(Z̄, θ̄) - Z̄‖ may be, relative to 1 + ‖Z̄‖; None for 1e-6, in float32 1e-4.

    Raises:
        InputError: no equilibrium (the remedy names a near one, if Newton's method finds it); a map of another shape,
            that is not finite, or cannot be differentiated.

    References:
        Section 2, "Connections between Static Stateful Distribution Transition Maps and LDS".
    """
    function = as_callable("f", f)
    Z, theta = _vector("state", state), _vector("input", input)
    dtype = jnp.result_type(Z, theta)
    Z, theta = Z.astype(dtype), theta.astype(dtype)
    arguments: dict[str, Array] = {"Z": Z, "input": theta}
    if policy is not None:
        arguments["M"] = _policy(policy, len(theta), len(Z)).astype(dtype)
    value = jnp.asarray(call("f", function, **arguments))
    if value.shape != Z.shape:
        raise fail(
            "f", f"a value of shape {value.shape}", f"give the next state, {Z.shape}", "Return one entry a state."
        )

    def of(*given: Array) -> Array:
        return jnp.asarray(call("f", function, **dict(zip(arguments, given, strict=True))), dtype)

    first, slopes = _derivatives(of, tuple(arguments.values()))
    if not all(bool(jnp.all(jnp.isfinite(array))) for array in (value, *first, *(slopes or ()))):
        raise fail(
            "f",
            "values or derivatives that are not finite",
            "be smooth at the equilibrium",
            "Evaluate f and jax.jacobian(f) there, and replace what divides by zero or takes the root of zero.",
        )
    A, B = first[0], first[1]
    residual = value.astype(dtype) - Z
    limit = (1e-6 if dtype == jnp.float64 else 1e-4) if tolerance is None else tolerance
    check_nonnegative("tolerance", limit, "Pass None for the default.")
    size = float(jnp.linalg.norm(residual))
    if size > limit * (1 + float(jnp.linalg.norm(Z))):
        raise fail("state", f"‖f(Z̄, θ̄) - Z̄‖ = {size:.3g}", "be an equilibrium", _near(of, arguments))
    reaction = offset_reaction = None
    if slopes is not None:
        centre = arguments["M"]
        matrix, shift = jnp.concatenate(slopes[:2], axis=1), slopes[2]
        reaction = Affine(-jnp.tensordot(matrix, centre, 3), matrix)
        offset_reaction = Affine(-jnp.tensordot(shift, centre, 3), shift)
    offset = value.astype(dtype) - A @ Z - B @ theta
    return Linearisation(function, Z, theta, arguments.get("M"), A, B, offset, residual, reaction, offset_reaction)


def _derivatives(of: Callable, point: tuple[Array, ...]) -> tuple[tuple[Array, ...], tuple[Array, ...] | None]:
    """(A, B), and where there is a policy the derivatives of A, B and f by it."""
    first = jax.jacobian(of, argnums=(0, 1))
    if len(point) == 2:
        return first(*point), None
    by_policy = jax.jacobian(lambda M: (*first(*point[:2], M), of(*point[:2], M)))(point[2])
    return first(*point), by_policy


def _near(of: Callable, arguments: dict[str, Array]) -> str:
    """Where Newton's method finds an equilibrium for the same input, in words."""
    Z, *rest = arguments.values()
    for _ in range(NEWTON_STEPS):
        gap = of(Z, *rest) - Z
        step = jnp.linalg.lstsq(jax.jacobian(of)(Z, *rest) - jnp.eye(len(Z), dtype=Z.dtype), -gap)[0]
        Z = Z + step
    gap = float(jnp.linalg.norm(of(Z, *rest) - Z))
    if np.isfinite(gap) and gap <= 1e-4 * (1 + float(jnp.linalg.norm(Z))):
        return f"For that input one is at {np.array2string(np.asarray(Z), precision=8, separator=', ')}."
    return "Solve f(Z, θ) = Z first, or pass another input."


def _vector(name: str, value: Any) -> Array:
    vector = as_array(name, value)
    if vector.ndim != 1 or not vector.size:
        raise fail(name, f"{vector.shape}", "be a vector", "Pass a single number x as [x].")
    return vector


def _policy(policy: Any, m: int, n: int) -> Array:
    array = as_array("policy", policy)
    if array.ndim != 3 or array.shape[1:] != (m, n):
        raise fail(
            "policy", f"{array.shape}", f"have shape (memory, input, state) = (H, {m}, {n})", "Pass problem.lift(M)."
        )
    return array
