"""How a run ended. The text of a member says what to do."""

from typing import Any

import equinox as eqx
import jax
import numpy as np


class Result(eqx.Enumeration):
    """Outcome of `solve`; compare with ==, read the text, which says what to do, with `Result[result]`.

    Attributes:
        success: the run ended as asked.
        running: stopped by max_steps before it ended.
        diverged: the iterates grew past the divergence threshold.
        nonfinite: a gradient or iterate was not finite.
        undersampled: the sample reached its limit before the standard error met the tolerance.
        not_differentiable: the reaction has no finite derivative at a policy on the way.
        not_converged: the tolerance was not reached.
    """

    success = "The run ended as asked."
    running = "The run was stopped by max_steps before it ended: raise max_steps."
    diverged = (
        "The iterates grew past the divergence threshold. A stable policy may exist all the same: use a smaller or "
        "diminishing step (pc.InverseStep), a bounded feasible set, or pc.StablePoint where moments are known."
    )
    nonfinite = (
        "A gradient or iterate was not finite; the last finite iterate is returned. Use a smaller step, or check "
        "the problem's scales; on an infinite horizon, start from a policy that keeps the world mean-square stable."
    )
    undersampled = (
        "The sample reached its limit before the standard error met the tolerance; the policy is returned with its "
        "error: raise tolerance, or pass sampling=pc.SampleAverage(limit=...)."
    )
    not_differentiable = (
        "The reaction has no finite derivative at a policy on the way, such as that of jnp.linalg.norm at zero: write "
        "norms as pc.Norm, roots and quotients so that their derivatives are finite, or start from another M0."
    )
    not_converged = (
        "The tolerance was not reached. The map may have no fixed point, or the method starts too far from one: try "
        "pc.StablePoint where repeated minimisation was used, another M0, pc.Continuation, or a larger tolerance."
    )


MEMBERS = {
    name: getattr(Result, name)
    for name in ("success", "running", "diverged", "nonfinite", "undersampled", "not_differentiable", "not_converged")
}


def ended(result: Any, member: Result) -> Any:
    """`result == member`, which costs nothing where the result is a member itself."""
    return np.asarray(result is member) if any(result is known for known in MEMBERS.values()) else result == member


def where(results: Result, member: Result) -> np.ndarray:
    """`results == member` of many known results, on the host, where nothing is compiled."""
    (values,), (value,) = jax.tree.leaves(results), jax.tree.leaves(member)
    return np.asarray(values) == value


def name_of(result: Result) -> str:
    """The name of a known result."""
    return next(name for name, member in MEMBERS.items() if bool(result == member))
