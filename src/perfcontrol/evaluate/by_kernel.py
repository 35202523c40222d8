"""Costs and gradients of sampled paths by the kernel in C++, where it is switched on and knows the problem."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from perfcontrol._linalg import as_dense
from perfcontrol.costs import QuadraticCost
from perfcontrol.evaluate.draw import draw_start
from perfcontrol.kernel.library import TARGET, in_use
from perfcontrol.perturbations import DenseDraws, DensePerturbation, NoPerturbation
from perfcontrol.perturbations.counted import Counted
from perfcontrol.perturbations.white_draws import WhiteDraws
from perfcontrol.problem import PerformativeProblem
from perfcontrol.random_keys import is_fast
from perfcontrol.random_vectors import Rademacher, Uniform

REGISTER = 64  # bytes of one number of all paths that the kernel works on together, `Lanes` in numbers.h
NONE, MATRICES, SIGNS, UNIFORM, PRODUCTS, NORMAL = range(6)  # `Source` in arguments.h
Plain = Callable[[PerformativeProblem, Array, Array, Key[Array, ""]], Array]


class _Noise(NamedTuple):
    """The noise as the kernel takes it: given, or drawn there about its centre."""

    kind: int
    key: Array
    w: Array | None = None  # (T, n)
    scale: Array | None = None  # (n,)
    centre: Array | None = None  # (n,)


class _Reaction(NamedTuple):
    """Δ as the kernel takes it: what is None is absent."""

    kind: int
    key: Array
    scale: Array | None = None  # (T,)
    location: Array | None = None  # (n, n), (T, n, n)
    matrices: Array | None = None  # (T, n, n)
    ahead: Array | None = None  # (T, n), as in `WhiteDraws`
    back: Array | None = None  # (T, n)
    rest: Array | None = None  # (T, 2), there or, of normal numbers, `Counted.chi`
    each: bool = False


def by_kernel(
    plain: Plain, problem: PerformativeProblem, policy: Array, deployed: Array, key: Key[Array, ""], gradient: bool
) -> Array:
    """`plain(problem, policy, deployed, key)`: the cost of the path that the key draws, or its gradient.

    `policy` and `deployed` are lifted, and so is the gradient. Derivatives are those of `plain`; there are none by
    traced numbers that a plain function inside of the problem closes over.
    """
    if not serves(problem) or policy.dtype != problem.dtype or _is_redrawn(problem, deployed, key):
        return plain(problem, policy, deployed, key)
    dynamic, static = eqx.partition((problem, policy, deployed, key), eqx.is_array)

    def run(dynamic: Any) -> Array:
        problem, policy, deployed, key = eqx.combine(dynamic, static)
        return _called(problem, policy, deployed, key, gradient)

    differentiable = jax.custom_jvp(run)
    differentiable.defjvp(lambda given, by: jax.jvp(lambda d: plain(*eqx.combine(d, static)), given, by))
    return differentiable(dynamic)


def serves(problem: PerformativeProblem) -> bool:
    """Whether the kernel is switched on, and knows problems of this kind."""
    law = type(problem.perturbation)  # a subclass may draw, or cost, otherwise
    on_state = problem.perturbation.columns(problem.state_size, problem.input_size) == problem.state_size
    known = law in (DensePerturbation, NoPerturbation) and on_state and type(problem.cost) is QuadraticCost
    return in_use() and known and problem.dtype in (np.float32, np.float64)


def _is_redrawn(problem: PerformativeProblem, deployed: Array, key: Key[Array, ""]) -> bool:
    """Whether matrices are too many to be held, and are none that the kernel draws itself."""
    if not isinstance(problem.perturbation, DensePerturbation):
        return False
    draws = eqx.filter_eval_shape(lambda: _drawn(problem, deployed, key))
    return not isinstance(draws, Counted | WhiteDraws | DenseDraws)


def _drawn(problem: PerformativeProblem, deployed: Array, key: Key[Array, ""]) -> Any:
    counted = problem.perturbation.counted(key, deployed, problem.horizon)  # type: ignore[attr-defined]
    return problem.perturbation.sample_along(key, deployed, problem.horizon) if counted is None else counted


def _called(problem: PerformativeProblem, policy: Array, deployed: Array, key: Key[Array, ""], gradient: bool) -> Array:
    x0, noise_key, perturbation_key = draw_start(problem, deployed, key)
    noise = _noise(problem, deployed, noise_key)
    reaction = _reaction(problem, deployed, perturbation_key)
    Q, R, cross = problem.cost.weights(problem.horizon)  # type: ignore[attr-defined]
    system, cost, dtype = problem.system, problem.cost, policy.dtype
    gain = problem.gain if problem.has_gain else None

    def given(array: Any, inner: int) -> Array:
        """With a leading axis of length 0 where absent, 1 where the same at all times."""
        if array is None:
            return jnp.zeros((0,) + (1,) * inner, dtype)
        dense = jnp.asarray(as_dense(array), dtype)
        return dense if dense.ndim > inner else dense[None]

    matrices = [given(matrix, 2) for matrix in (system.A, system.B, gain, Q, R, cross)]
    targets = [given(target, 1) for target in (cost.state_target, cost.input_target)]  # type: ignore[attr-defined]
    scale = None if reaction.scale is None else reaction.scale[:, None]
    drawn = [given(scale, 1), given(reaction.location, 2), given(reaction.matrices, 2)]
    drawn += [given(array, 1) for array in (reaction.ahead, reaction.back, reaction.rest)]
    noise_law = [jnp.zeros(0, dtype) if array is None else array for array in (noise.scale, noise.centre)]
    answers = jax.ShapeDtypeStruct((), dtype), jax.ShapeDtypeStruct(policy.shape if gradient else (0,), dtype)
    call = jax.ffi.ffi_call(TARGET, answers, vmap_method="expand_dims")
    options = {"horizon": np.int64(problem.horizon), "redrawn": reaction.each, "gradient": gradient}
    options |= {"reaction": np.int64(reaction.kind), "noise": np.int64(noise.kind)}
    given_noise, keys = given(noise.w, 1), (reaction.key, noise.key)
    path_cost, by_policy = call(*matrices, *targets, policy, x0, given_noise, *drawn, *noise_law, *keys, **options)
    return by_policy if gradient else path_cost


def _noise(problem: PerformativeProblem, deployed: Array, key: Key[Array, ""]) -> _Noise:
    law, dtype = problem.noise_under(deployed), deployed.dtype
    fast = is_fast(key) and law.mean.dtype == dtype
    if fast and type(law) is Rademacher:
        return _Noise(SIGNS, jax.random.key_data(key), scale=jnp.atleast_1d(law.scale), centre=law.mean)
    if fast and type(law) is Uniform:
        scale = jnp.atleast_1d(law.high - law.low) / np.sqrt(12)
        return _Noise(UNIFORM, jax.random.key_data(key), scale=scale.astype(dtype), centre=law.mean)
    return _Noise(NONE, jnp.zeros(4, np.uint32), w=law.sample(key, problem.horizon).astype(dtype))


def _reaction(problem: PerformativeProblem, deployed: Array, key: Key[Array, ""]) -> _Reaction:
    nothing = jnp.zeros(4, np.uint32)
    if not isinstance(problem.perturbation, DensePerturbation):
        return _Reaction(NONE, nothing)
    drawn = _drawn(problem, deployed, key)
    if isinstance(drawn, Counted):
        kind = {"rademacher": SIGNS, "uniform": UNIFORM, "normal": NORMAL}[drawn.law]
        words = jax.random.key_data(drawn.key)
        return _Reaction(kind, words, drawn.scale, drawn.location, rest=drawn.chi, each=drawn.each)
    if isinstance(drawn, WhiteDraws):
        products = {"ahead": drawn.ahead, "back": drawn.back, "rest": drawn.rest}
        return _Reaction(PRODUCTS, nothing, drawn.scale, drawn.location, **products)
    return _Reaction(MATRICES, nothing, jnp.ones(1, deployed.dtype), matrices=drawn.matrices)
