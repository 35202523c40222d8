"""How much memory there is for arrays."""

import os
from pathlib import Path

import jax

CONTAINER = Path("/sys/fs/cgroup/memory.max")  # what Linux grants a container


def memory_size() -> int | None:
    """Bytes of the device that JAX computes on, on a CPU those of the machine or its container; None if unknown."""
    granted = (jax.devices()[0].memory_stats() or {}).get("bytes_limit")
    if granted or jax.default_backend() != "cpu":
        return granted
    try:
        machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not every system tells
        return None
    try:
        return min(machine, int(CONTAINER.read_text()))
    except (OSError, ValueError):  # no container, or one without a limit
        return machine
