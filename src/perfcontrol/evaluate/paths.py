"""Many paths: a few together, so that what they hold stays in the cache, and on all devices where that is asked for."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Key

from perfcontrol._linalg import FUSED
from perfcontrol._programs import known
from perfcontrol.evaluate import by_kernel
from perfcontrol.problem import PerformativeProblem

LANES = 8  # paths that a device should have at least
REGISTER = 32  # bytes of one number of all paths worked on together: with more the compiler leaves vectors alone
REGISTERS = 4  # of paths for one call of the kernel
TOGETHER = 2**27  # bytes of paths that the kernel is still better given together, in one register
CACHE = 2**24  # bytes of paths beyond which working on more of them together slows them down


def _drawn(problem: PerformativeProblem, along: bool) -> list[Any]:
    """Shapes of what is drawn of the perturbations for one path."""
    policy = jax.ShapeDtypeStruct(problem.lifted_shape, problem.dtype)
    key = jax.eval_shape(lambda: jax.random.key(0))
    draws = eqx.filter_eval_shape(
        lambda p, key, M: (p.sample_along if along else p.sample)(key, M, problem.horizon).steps,
        problem.perturbation,
        key,
        policy,
    )
    return jax.tree.leaves(draws)


def bytes_held(problem: PerformativeProblem, along: bool = False) -> int:
    """Bytes of one path: its states, inputs, noise and perturbations."""
    numbers = (problem.horizon + 1) * (2 * problem.state_size + problem.input_size)
    drawn = sum(leaf.size * leaf.dtype.itemsize for leaf in _drawn(problem, along))
    return numbers * problem.dtype.itemsize + drawn


def lanes(problem: PerformativeProblem, along: bool = False) -> int:
    """How many paths a batched loop works on together: a register's, fewer where what they hold leaves the cache.

    Paths that have large matrices of their own are better worked on one by one; the kernel is given several registers
    of them at once.
    """
    fitting = CACHE // bytes_held(problem, along)
    if by_kernel.serves(problem):
        register = by_kernel.REGISTER // problem.dtype.itemsize
        least = register if register * bytes_held(problem, along) <= TOGETHER else 1
        return max(least, min(REGISTERS * register, fitting))
    if any(leaf.ndim == 3 and max(leaf.shape[1:]) > FUSED for leaf in _drawn(problem, along)):
        return 1
    return max(1, min(REGISTER // problem.dtype.itemsize, fitting))


def devices_for(samples: int, *given: Any) -> int:
    """On how many devices to work: all of this process where numbers are known and each has lanes to fill, or one."""
    devices = len(jax.local_devices())
    return devices if known(*given) and samples >= LANES * devices else 1


def over_paths(
    problem: PerformativeProblem,
    one: Callable[[Array], Any],
    key: Key[Array, ""],
    samples: int,
    along: bool = False,
    devices: int = 1,
) -> Any:
    """What `one` makes of `fold_in(key, s)` for s = 0..samples-1, with a leading axis; pure, for compiled code.

    The same on any number of devices, to rounding.
    """
    if samples == 1:
        return jax.tree.map(lambda leaf: leaf[None], one(jax.random.fold_in(key, 0)))
    together = min(lanes(problem, along), samples)

    def some(indices: Array) -> Any:
        return jax.lax.map(lambda index: one(jax.random.fold_in(key, index)), indices, batch_size=together)

    if devices == 1:
        return some(jnp.arange(samples))
    mesh, split = Mesh(np.array(jax.local_devices()), ("paths",)), PartitionSpec("paths")
    full = jnp.arange(-(-samples // devices) * devices) % samples
    spread = jax.shard_map(some, mesh=mesh, in_specs=split, out_specs=split, check_vma=False)(full)
    return jax.tree.map(lambda leaf: leaf[:samples], spread)
