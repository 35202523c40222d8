"""Simulation: closed-loop paths of a policy while another, or the same, is deployed.

The time loop holds one matrix-vector product, one perturbation product and an addition; everything that does not
depend on the state is computed in bulk around it. Under vmap it takes a step of all paths at once (`time_loop`).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from perfcontrol._checks import check_integer, check_key, fail
from perfcontrol._linalg import Diagonal, Matrix, along_time, times
from perfcontrol._memory import memory_size
from perfcontrol._programs import program
from perfcontrol.evaluate.draw import draw_noise, draw_path
from perfcontrol.evaluate.paths import bytes_held, devices_for, over_paths
from perfcontrol.evaluate.time_loop import time_loop
from perfcontrol.perturbations import Draws, PathDraws
from perfcontrol.policy import feedforward
from perfcontrol.problem import PerformativeProblem, check_problem


class Path(eqx.Module):
    """One closed-loop path: x (T+1, n), u (T+1, m), w (T, n) and the perturbations drawn."""

    x: Float[Array, "T1 n"]
    u: Float[Array, "T1 m"]
    w: Float[Array, "T n"]
    draws: Any  # Draws, or PathDraws from `sample_along`


class Trajectories(eqx.Module):
    """Simulated paths.

    Attributes:
        x: states, (samples, T+1, n).
        u: inputs, (samples, T+1, m).
        w: noise, (samples, T, n).
        cost: summed over the T+1 stages, (samples,); averaged over them where an infinite horizon was cut off.
        draws: the perturbations, every leaf with a leading sample axis.
    """

    x: Float[Array, "*S T1 n"]
    u: Float[Array, "*S T1 m"]
    w: Float[Array, "*S T n"]
    cost: Float[Array, "*S"]
    draws: Draws


def input_term(B: Matrix, v: Float[Array, "T1 m"]) -> Float[Array, "T n"]:
    """B_t v_t for t = 0..T-1."""
    if isinstance(B, Diagonal):
        return B.values * v[:-1]
    return v[:-1] @ B.T if B.ndim == 2 else jnp.einsum("tnm,tm->tn", B, v[:-1])


def input_adjoint(B: Matrix, y: Float[Array, "T n"]) -> Float[Array, "T m"]:
    """B_tᵀ y_t for t = 0..T-1."""
    if isinstance(B, Diagonal):
        return B.values * y
    return y @ B if B.ndim == 2 else jnp.einsum("tnm,tn->tm", B, y)


def sample_path(problem: PerformativeProblem, policy: Array, deployed: Array, key: Key[Array, ""]) -> Path:
    """One path; `policy` and `deployed` are lifted."""
    return run_path(problem, policy, *draw_path(problem, deployed, key))


def sample_along(problem: PerformativeProblem, policy: Array, deployed: Array, key: Key[Array, ""]) -> Path:
    """A path of the same law whose perturbations serve for its cost and its gradient alone, and are drawn for less."""
    x0, w, perturbation_key = draw_noise(problem, deployed, key)
    draws = problem.perturbation.sample_along(perturbation_key, deployed, problem.horizon)
    return run_path(problem, policy, x0, w, draws)


def run_path(problem: PerformativeProblem, policy: Array, x0: Array, w: Array, draws: PathDraws) -> Path:
    """The path of given noise and perturbations; `policy` is lifted."""
    system, gain = problem.system, problem.gain
    n, m = problem.state_size, problem.input_size
    acts_on_input = problem.perturbation.columns(n, m) > n
    v = feedforward(policy, w)
    offset = input_term(system.B, v) + w
    loop = problem.closed_loop(system.A, system.B)
    varying = loop.ndim == 3

    def advance(fixed: Any, x: Array, step: Any) -> tuple[Array, Array]:
        loop, draws = fixed
        offset_t, draw, loop_t, u_part = step
        z = x
        if acts_on_input:
            v_t, gain_t = u_part
            z = jnp.concatenate([x, v_t - times(gain_t, x)])
        following = times(loop_t if varying else loop, x) + draws.matvec_step(draw, z) + offset_t
        return following, following

    u_part = (v[:-1], along_time(gain, 2, problem.horizon + 1)[:-1]) if acts_on_input else None
    steps = (offset, draws.steps, loop if varying else None, u_part)
    states = time_loop(advance, (None if varying else loop, draws), x0, steps, draws.side_by_side)
    x = jnp.concatenate([x0[None], states])
    return Path(x, v - problem.feedback(x) if problem.has_gain else v, w, draws)


def _check_fits(problem: PerformativeProblem, samples: int) -> None:
    """Raise, before any work, where the paths asked for are larger than the memory."""
    n, m, memory = problem.state_size, problem.input_size, memory_size()
    most = (problem.horizon + 1) * (2 * n + m + n * (n + m)) * problem.dtype.itemsize  # were all matrices held
    if memory is None or samples * most <= memory or samples * (one := bytes_held(problem)) <= memory:
        return
    fewer = f"Ask for at most {memory // one} samples" if one <= memory else "Shorten the horizon"
    raise fail(
        "samples",
        f"{samples} paths of {problem.horizon} steps: {samples * one / 2**30:.1f} GiB",
        f"fit into the memory of {memory / 2**30:.1f} GiB",
        f"{fewer}, or use pc.estimate_cost and pc.sample_gradient, which hold a few paths at a time.",
    )


@program(on_device=True)
def _simulate(
    problem: PerformativeProblem, M: Array, deployed: Array, key: Array, samples: int, devices: int
) -> Trajectories:
    policy, reacting = problem.structure.lift(M), problem.structure.lift(deployed)

    def one(key: Array) -> tuple[Array, Array, Array, Array, Draws]:
        path = sample_path(problem, policy, reacting, key)
        return path.x, path.u, path.w, jnp.sum(problem.cost.path_cost(path.x, path.u)), path.draws

    return Trajectories(*over_paths(problem, one, key, samples, devices=devices))


def check_pair(problem: PerformativeProblem, M: Any, deployed: Any) -> tuple[Array, Array]:
    """Both policies as arrays; `deployed=None` means M."""
    M = check_problem(problem).check_policy("M", M)
    return M, M if deployed is None else problem.check_policy("deployed", deployed)


def cut_off(problem: PerformativeProblem, truncation: Any) -> tuple[PerformativeProblem, float]:
    """The problem to simulate, and the weight of its costs: an infinite horizon is cut off, and costs averaged."""
    if problem.is_finite:
        if truncation is not None:
            got = f"{truncation} for a horizon of {problem.horizon}"
            raise fail("truncation", got, "be left out where the horizon is finite", "Use problem.truncated(T).")
        return problem, 1.0
    if truncation is None:
        required = "say how many steps to simulate where the horizon is infinite"
        raise fail("truncation", "None", required, "Pass truncation=1000: the bias falls like 1/truncation.")
    truncation = check_integer("truncation", truncation, 1)
    return problem.truncated(truncation), 1 / (truncation + 1)


class Asked(NamedTuple):
    """What is asked of simulated paths, checked: arguments of a program, and the weight of its answer."""

    problem: PerformativeProblem
    M: Array
    deployed: Array
    key: Key[Array, ""]
    samples: int
    weight: float

    @property
    def arguments(self) -> tuple[Any, ...]:
        """All but the weight, and the number of devices to work on."""
        given = self.problem, self.M, self.deployed, self.key
        return *given, self.samples, devices_for(self.samples, *given)


def check_paths(
    problem: PerformativeProblem, M: Any, deployed: Any, key: Any, samples: Any, truncation: Any, least: int = 1
) -> Asked:
    """The arguments that `simulate`, `pc.estimate_cost` and `pc.sample_gradient` have in common."""
    M, reacting = check_pair(problem, M, deployed)
    finite, weight = cut_off(problem, truncation)
    return Asked(finite, M, reacting, check_key(key), check_integer("samples", samples, least), weight)


def simulate(
    problem: PerformativeProblem,
    M: Any,
    *,
    deployed: Any = None,
    key: Any = None,
    samples: int = 1,
    truncation: int | None = None,
) -> Trajectories:
    """Independent closed-loop paths of the policy M while the world reacts to `deployed` (None: to M itself).

    Sample s uses `fold_in(key, s)`: the first samples stay the same when more are asked for.

    Args:
        problem: the problem.
        M: free policy parameters, `problem.policy_shape`.
        deployed: likewise, the policy that the world reacts to; None for M itself.
        key: JAX random key; required.
        samples: number of paths.
        truncation: T of the paths, for an infinite horizon and only there.

    Raises:
        InputError: wrong shapes, a missing key, samples < 1, an infinite horizon without truncation, paths that do
            not fit into the memory.
    """
    asked = check_paths(problem, M, deployed, key, samples, truncation)
    _check_fits(asked.problem, asked.samples)
    *arguments, devices = asked.arguments
    paths = _simulate(*arguments, devices)
    if devices > 1:  # what is done with paths next is no affair of all devices
        paths = jax.device_put(paths, jax.local_devices()[0])
    return eqx.tree_at(lambda p: p.cost, paths, asked.weight * paths.cost)
