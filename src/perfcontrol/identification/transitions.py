"""The transitions of some logs as one table: what every regression here works on."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from perfcontrol._checks import check_integer, fail
from perfcontrol.identification.logs import Logs

UNITS = 40  # fewer episodes than this are cut into blocks, for the sake of standard errors
ROWS = 20_000  # transitions worked on at a time


class Transitions(NamedTuple):
    """y = F x + B v + mean noise + error for every transition, v = u + K x the input beside the feedback.

    x (N, n), v (N, m), y (N, n). unit (U+1,): where each unit starts, a unit being an episode or a block of one.
    group (U,): the deployment of each unit. first (E,): the first unit of each episode. policies (G, H, m, n).
    gain (m, n): K, zero where it varies in time.
    """

    x: np.ndarray
    v: np.ndarray
    y: np.ndarray
    unit: np.ndarray
    group: np.ndarray
    first: np.ndarray
    policies: np.ndarray
    gain: np.ndarray

    @property
    def regressors(self) -> np.ndarray:
        """[x, v, 1], (N, n+m+1)."""
        return np.concatenate([self.x, self.v, np.ones((len(self.x), 1))], axis=1)

    def moved(self, columns: int) -> np.ndarray:
        """What perturbations with so many columns act on: x, or [x, u]."""
        return self.x if columns == self.x.shape[1] else np.concatenate([self.x, self.v - self.x @ self.gain.T], axis=1)

    @property
    def row_group(self) -> np.ndarray:
        """The deployment of each transition, (N,)."""
        return np.repeat(self.group, np.diff(self.unit))

    def pieces(self, rows: int = ROWS) -> Iterator[tuple[slice, slice]]:
        """Slices of units, and of their rows, with about `rows` transitions each."""
        first = 0
        while first < len(self.group):
            last = int(np.searchsorted(self.unit, self.unit[first] + rows, side="right")) - 1
            last = max(last, first + 1)
            yield slice(first, last), slice(int(self.unit[first]), int(self.unit[last]))
            first = last


def transitions_of(logs: Any, gain: Any, memory: int | None) -> Transitions:
    """The table of checked logs; `gain` and `memory` as `fit` takes them."""
    if not isinstance(logs, Logs):
        raise fail("logs", type(logs).__name__, "be a pc.Logs", "Build it with pc.Logs(x, u, deployed).")
    n, m = logs.state_size, logs.input_size
    policies = _lengthened(logs.policies, memory)
    gains = _gains(gain, m, n, max(len(u) for u in logs.u))
    constant = gains if gains.ndim == 2 else np.zeros((m, n))
    cut = -(-UNITS // len(logs)) if len(logs) < UNITS else 1
    x, v, y, lengths, group, first = [], [], [], [], [], []
    for states, inputs, g in zip(logs.x, logs.u, logs.deployment, strict=True):
        count = len(states) - 1
        x.append(states[:-1])
        y.append(states[1:])
        v.append(inputs[:count] + states[:-1] @ constant.T)
        blocks = np.array_split(np.arange(count), min(cut, count))
        first.append(len(group))
        lengths += [len(block) for block in blocks]
        group += [g] * len(blocks)
    start = np.concatenate([[0], np.cumsum(lengths)])
    table = (np.concatenate(x), np.concatenate(v), np.concatenate(y))
    data = Transitions(*table, start, np.array(group), np.array(first), policies, constant)
    _check_sign(data)
    return data


def _lengthened(policies: np.ndarray, memory: int | None) -> np.ndarray:
    logged = policies.shape[1]
    if memory is None:
        return policies
    memory = check_integer("memory", memory, 1)
    if np.any(policies[:, memory:] != 0):
        required = f"be at least {logged}, the lags of the deployed policies"
        raise fail("memory", str(memory), required, "Leave it out to take theirs.")
    padding = np.zeros((len(policies), max(memory - logged, 0), *policies.shape[2:]))
    return np.concatenate([policies[:, :memory], padding], axis=1)


def _gains(gain: Any, m: int, n: int, length: int) -> np.ndarray:
    """K as an array (m, n), or (time, m, n)."""
    gains = np.asarray(gain, dtype=float)
    if gains.ndim == 0 and (gains == 0 or m == n == 1):
        gains = np.full((m, n), float(gains))
    if gains.ndim not in (2, 3) or gains.shape[-2:] != (m, n) or (gains.ndim == 3 and len(gains) < length):
        hint = "The last two axes look swapped." if gains.shape[-2:] == (n, m) else "The sign is u = -K x + ..."
        raise fail("gain", f"{gains.shape}", f"have shape (m, n) = ({m}, {n}), or (T+1, {m}, {n})", hint)
    if not np.all(np.isfinite(gains)):
        raise fail("gain", "an infinite or missing entry", "have finite entries only", "Pass one of pc.design_gain.")
    return gains


def _check_sign(data: Transitions) -> None:
    """Refuse a gain of the wrong sign: without a policy the input is -K x."""
    idle = np.all(data.policies == 0, axis=(1, 2, 3))[data.row_group]
    if not idle.any() or not data.gain.any():
        return
    v, feedback = data.v[idle], data.x[idle] @ data.gain.T
    if np.linalg.norm(v - 2 * feedback) < 1e-3 * np.linalg.norm(v):
        raise fail("gain", "inputs u = +K x where M = 0", "have the sign of u = -K x", "Pass -gain.")
