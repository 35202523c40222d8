"""Convexity, smoothness and the declared constants of a stage function, checked at points and between them."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from perfcontrol._checks import fail, is_concrete
from perfcontrol._programs import program

REMEDY = "Convexity is needed here: change the function, or use pc.RSGD, which only follows gradients."


@program
def _curvature(function: Callable, t: Array, x: Array, u: Array) -> tuple[Array, Array]:
    """Gradients (s, n+m) and Hessians (s, n+m, n+m) at stages t (s,), states (s, n) and inputs (s, m)."""

    def gradient(t: Array, z: Array) -> Array:
        return jax.grad(lambda z: function(t, z[: x.shape[1]], z[x.shape[1] :]))(z)

    points = jax.numpy.concatenate([x, u], axis=1)
    return jax.vmap(gradient)(t, points), jax.vmap(jax.jacfwd(gradient, argnums=1))(t, points)


def check_convexity(function: Callable, constants: dict[str, Any], t: Any, x: Any, u: Any) -> None:
    """Raise where derivatives at the points are not finite, not those of a convex function, or break a constant.

    Args:
        function: (t, x, u) -> scalar.
        constants: `strong_convexity` and `smoothness` as declared, None where they are not.
        t: stages, (s,), ascending: points of one stage are compared with one another.
        x: states, (s, n).
        u: inputs, (s, m).
    """
    gradients, hessians = (np.asarray(part, dtype=float) for part in _curvature(function, t, x, u))

    def at(index: int) -> str:
        return f"at t = {int(t[index])}, x = {np.asarray(x)[index]}, u = {np.asarray(u)[index]}"

    finite = np.isfinite(gradients).all(axis=1) & np.isfinite(hessians).all(axis=(1, 2))
    if not finite.all():
        remedy = "Smooth its kinks, as in jnp.sqrt(1e-6 + x**2) for |x|."
        got = f"a derivative that is not {at(int(np.argmin(finite)))}"
        raise fail("function", got, "have finite derivatives", remedy)
    values = np.linalg.eigvalsh((hessians + np.swapaxes(hessians, 1, 2)) / 2)
    slack = float(np.sqrt(np.finfo(np.asarray(x).dtype).eps))
    rounding = slack * np.abs(values).max(axis=1)
    lowest = int(np.argmin(values[:, 0] + rounding))
    if values[lowest, 0] < -rounding[lowest]:
        got = f"a Hessian with the eigenvalue {values[lowest, 0]:.3g} {at(lowest)}"
        raise fail("function", got, "be convex in (x, u)", REMEDY)
    # Kinks do not show in Hessians: between two points of a stage, gradients must not turn back.
    z = np.concatenate([x, u], axis=1)
    moved, turned = np.diff(z, axis=0), np.diff(gradients, axis=0)
    length = np.linalg.norm(moved, axis=1)
    pairs = np.flatnonzero((np.diff(t) == 0) & (length > 0))
    along = np.sum(moved * turned, axis=1)[pairs] / length[pairs] ** 2  # curvature between the two
    scale = np.linalg.norm(gradients, axis=1)
    rounding = slack * np.maximum(scale[pairs], scale[pairs + 1]) / length[pairs]
    if pairs.size and np.any(along < -rounding):
        worst = int(np.argmin(along + rounding))
        turn = f"gradients that turn back by {-along[worst]:.3g} a unit"
        got = f"{turn} between the points {at(pairs[worst])} and {at(pairs[worst] + 1)}"
        raise fail("function", got, "be convex in (x, u)", REMEDY)
    _check_constants(constants, values, along, slack)


def _check_constants(constants: dict[str, Any], values: np.ndarray, along: np.ndarray, slack: float) -> None:
    least = float(min(values[:, 0].min(), along.min(initial=np.inf)))
    most = float(max(values[:, -1].max(), along.max(initial=-np.inf)))
    room = slack * max(abs(most), abs(least))
    mu, sigma = constants["strong_convexity"], constants["smoothness"]
    if mu is not None and is_concrete(mu) and float(mu) > least + room:
        got = f"{float(mu):.6g}, where a curvature of {least:.6g} was found"
        raise fail("strong_convexity", got, "be the least curvature of the cost", "Lower it, or pass None.")
    if sigma is not None and is_concrete(sigma) and float(sigma) < most - room:
        got = f"{float(sigma):.6g}, where a curvature of {most:.6g} was found"
        raise fail("smoothness", got, "be the largest curvature of the cost", "Raise it, or pass None.")
