"""Batched compiled runs: stacked problems, many seeds, every host device busy."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from perfcontrol.problem import PerformativeProblem

BATCH = 8  # runs worked on together on one device: they stay in cache


def stack_problems(problems: list[PerformativeProblem]) -> PerformativeProblem:
    """Problems of equal structure as one, with a leading axis on every array."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)


def in_single_precision(problem: PerformativeProblem) -> PerformativeProblem:
    """The problem with every floating-point array in float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, problem)


def pick(problems: PerformativeProblem, index: Array) -> PerformativeProblem:
    """One problem of a stack."""
    return jax.tree.map(lambda leaf: leaf[index] if eqx.is_array(leaf) else leaf, problems)


def map_over_devices(function: Callable[..., Any], batch: int = BATCH) -> Callable[..., Any]:
    """`function` mapped over the leading axis of its array arguments, shared out over all devices; compiled once.

    The axis is padded by repeating its last entry where the devices do not divide it.
    """
    devices = np.array(jax.devices())
    mesh = Mesh(devices, ("runs",))
    spec = PartitionSpec("runs")

    def local(arguments: Any) -> Any:
        return jax.lax.map(lambda one: function(*one), arguments, batch_size=batch)

    compiled = jax.jit(jax.shard_map(local, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))

    def call(*arguments: Any) -> Any:
        count = jax.tree.leaves(arguments)[0].shape[0]
        short = -count % len(devices)

        def pad(leaf: Any) -> Array:
            leaf = jnp.asarray(leaf)
            return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], short, axis=0)]) if short else leaf

        return jax.tree.map(lambda leaf: leaf[:count], compiled(jax.tree.map(pad, arguments)))

    return call
