"""Logs: what was seen of a plant, episode by episode, and which policy was deployed in each.

Kept on the host in double precision, whatever JAX's own: identification is statistics, not simulation.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from perfcontrol._checks import as_names, check_integer, check_key, fail
from perfcontrol.evaluate import simulate
from perfcontrol.identification.files import from_csv, from_dataset, to_csv, to_dataset
from perfcontrol.problem import PerformativeProblem


class Logs(eqx.Module):
    """Episodes of a plant: states, inputs, and the policy that was deployed.

    Args:
        x: states, (E, T+1, n), or a list of E arrays (T_e+1, n) where lengths differ.
        u: inputs, (E, T, m) or (E, T+1, m) (the input of the last state tells nothing of the dynamics), or a list.
        deployed: (E, memory, m, n), the full policy in force in each episode; (memory, m, n) if it was always the same.
        state_names: n names of the states, or None. Files, tables and fitted systems carry them.
        input_names: m names of the inputs, or None.

    Raises:
        InputError: shapes that do not fit one another, missing or infinite values, an episode without a transition,
            names that do not tell all signals apart.

    `policies` (G, memory, m, n) are the different policies in order of appearance, and `deployment` (E,) says which of
    them each episode belongs to.
    """

    x: tuple[np.ndarray, ...]
    u: tuple[np.ndarray, ...]
    deployed: np.ndarray
    policies: np.ndarray
    deployment: np.ndarray
    state_names: tuple[str, ...] | None = eqx.field(static=True)
    input_names: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(self, x: Any, u: Any, deployed: Any, state_names: Any = None, input_names: Any = None):
        self.x = _episodes("x", x, "(episode, time, state)")
        self.u = _episodes("u", u, "(episode, time, input)")
        if len(self.x) != len(self.u):
            raise fail("u", f"{len(self.u)} episodes", f"have {len(self.x)} episodes, as x has", "Log both together.")
        n, m = self.x[0].shape[1], self.u[0].shape[1]
        for e, (states, inputs) in enumerate(zip(self.x, self.u, strict=True)):
            _check_episode(e, states, inputs, n, m)
        deployed = _numbers("deployed", deployed)
        if deployed.ndim == 3 and (len(deployed) != len(self.x) or len(deployed) == 1):
            deployed = np.broadcast_to(deployed, (len(self.x), *deployed.shape))
        if deployed.ndim != 4 or deployed.shape[0] != len(self.x) or deployed.shape[1] < 1:
            required = f"have shape (episodes, memory, m, n) = ({len(self.x)}, memory, {m}, {n})"
            raise fail("deployed", f"{deployed.shape}", required, "Pass one policy (memory, m, n) for each episode.")
        if deployed.shape[2:] != (m, n):
            swapped = deployed.shape[2:] == (n, m)
            hint = "The last two axes look swapped." if swapped else "A policy maps the noise (n) to the input (m)."
            raise fail("deployed", f"policies of shape {deployed.shape[1:]}", f"have shape (memory, {m}, {n})", hint)
        self.deployed = deployed + 0.0  # a copy, in which -0.0 and 0.0 are the same policy
        self.policies, self.deployment = _grouped(self.deployed)
        self.state_names = as_names("state_names", state_names, n)
        self.input_names = as_names("input_names", input_names, m)
        shared = set(self.state_names or ()) & set(self.input_names or ())
        if shared:
            required = "be none of the states"
            raise fail(
                "input_names",
                f"{sorted(shared)}, which are states",
                required,
                "Rename one of them: a signal is one or the other.",
            )

    @classmethod
    def simulate(cls, problem: PerformativeProblem, policies: Any, key: Any, episodes: int) -> "Logs":
        """So many simulated episodes of each policy, deployed and followed.

        Args:
            problem: the plant.
            policies: (P, *policy_shape), free parameters, or a list of them.
            key: JAX random key.
            episodes: of each policy.
        """
        check_integer("episodes", episodes, 1)
        key = check_key(key)
        lifted = [problem.lift(M) for M in policies]
        if not lifted:
            raise fail(
                "policies", "none", "hold at least one policy", "Pass for example problem.initial_policy()[None]."
            )
        paths = [
            simulate(problem, M, key=jax.random.fold_in(key, index), samples=episodes)
            for index, M in enumerate(policies)
        ]
        return cls(
            np.concatenate([np.asarray(path.x) for path in paths]),
            np.concatenate([np.asarray(path.u) for path in paths]),
            np.repeat(np.stack([np.asarray(M) for M in lifted]), episodes, axis=0),
            problem.system.state_names,
            problem.system.input_names,
        )

    @property
    def state_size(self) -> int:
        """n."""
        return self.x[0].shape[1]

    @property
    def input_size(self) -> int:
        """m."""
        return self.u[0].shape[1]

    @property
    def memory(self) -> int:
        """Lags of the deployed policies."""
        return self.deployed.shape[1]

    @property
    def transitions(self) -> int:
        """How many pairs (x_t, x_{t+1}) there are."""
        return sum(len(states) - 1 for states in self.x)

    def __len__(self) -> int:
        return len(self.x)

    def __add__(self, other: "Logs") -> "Logs":
        """The episodes of both, of the same signals."""
        deployed = np.concatenate([self.deployed, other.deployed])
        names = (_common(self, other, kind) for kind in ("state_names", "input_names"))
        return Logs(self.x + other.x, self.u + other.u, deployed, *names)

    def __getitem__(self, episodes: Any) -> "Logs":
        """The episodes of a slice, a list of indices or a mask."""
        chosen = np.atleast_1d(np.arange(len(self))[episodes])
        x, u = [self.x[e] for e in chosen], [self.u[e] for e in chosen]
        return Logs(x, u, self.deployed[chosen], self.state_names, self.input_names)

    def __str__(self) -> str:
        counts = np.bincount(self.deployment)
        return (
            f"Logs of {len(self)} episodes ({self.transitions} transitions) of a system with {self.state_size} states "
            f"and {self.input_size} inputs, under {len(counts)} "
            + ("policy." if len(counts) == 1 else f"policies ({', '.join(map(str, counts))} episodes).")
        )

    def to_dataset(self) -> Any:
        """An xarray Dataset: x (episode, time, state), u (episode, time, input), deployed; `transitions` an episode."""
        return to_dataset(self)

    @classmethod
    def from_dataset(cls, dataset: Any) -> "Logs":
        """Logs from a Dataset as `to_dataset` makes it; values past the end of an episode are ignored."""
        return cls(*from_dataset(dataset))

    def to_csv(self, folder: str | Path) -> None:
        """Write a new folder with one file an episode, `episodes.csv` and `policies.csv`; all of it or nothing."""
        to_csv(self, Path(folder))

    @classmethod
    def from_csv(cls, folder: str | Path) -> "Logs":
        """Logs from a folder as `to_csv` writes it. `policies.csv` names the signals, a column each of the episodes."""
        return cls(*from_csv(Path(folder)))


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "biuf":
            raise TypeError(f"dtype {array.dtype}")
    except (TypeError, ValueError) as error:
        remedy = "Pass rectangular arrays; a list of them where lengths differ."
        raise fail(name, f"{type(value).__name__} ({error})", "be an array of real numbers", remedy) from error
    array = array.astype(float)
    if not np.all(np.isfinite(array)):
        index = np.argwhere(~np.isfinite(array))[0].tolist()
        remedy = "Cut the episode there: two episodes lose one transition, an invented value spoils two."
        raise fail(name, f"{array[tuple(index)]} at index {index}", "have finite values only", remedy)
    return array


def _episodes(name: str, value: Any, labels: str) -> tuple[np.ndarray, ...]:
    ragged = isinstance(value, Sequence) and len({np.shape(episode)[:1] for episode in value}) > 1
    if not ragged:
        array = _numbers(name, value)
        if array.ndim != 3:
            hint = "A single episode needs a leading axis: x[None]." if array.ndim == 2 else "Check the axis order."
            raise fail(name, f"shape {array.shape}", f"have axes {labels}", hint)
        episodes = tuple(array)
    else:
        episodes = tuple(_numbers(f"{name}[{e}]", episode) for e, episode in enumerate(value))
    if not episodes:
        raise fail(name, "no episode", "hold at least one episode", "Pass at least one episode.")
    return episodes


def _check_episode(e: int, states: np.ndarray, inputs: np.ndarray, n: int, m: int) -> None:
    for name, array, size in (("x", states, n), ("u", inputs, m)):
        if array.ndim != 2 or array.shape[1] != size or size == 0:
            required = f"have shape (time, {size})"
            raise fail(f"{name}[{e}]", f"{array.shape}", required, "Log the same signals in every episode.")
    if len(states) < 2:
        raise fail(f"x[{e}]", f"{len(states)} times", "cover at least one transition", "Leave this episode out.")
    if len(inputs) not in (len(states) - 1, len(states)):
        required = f"have {len(states) - 1} or {len(states)} times: x has {len(states)}"
        raise fail(
            f"u[{e}]",
            f"{len(inputs)}",
            required,
            "Pass one input for each state, or for each but the last: u_t is applied at x_t.",
        )


def _grouped(deployed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different policies in order of appearance, and the index of each episode's among them."""
    first: dict[bytes, int] = {}
    deployment = np.array([first.setdefault(policy.tobytes(), len(first)) for policy in deployed])
    return np.stack([deployed[np.argmax(deployment == g)] for g in range(len(first))]), deployment


def _common(one: Logs, other: Logs, kind: str) -> tuple[str, ...] | None:
    """The names that two logs share; those of the other where one has none."""
    first, second = getattr(one, kind), getattr(other, kind)
    if first is not None and second is not None and first != second:
        raise fail(
            kind,
            f"{list(first)} and {list(second)}",
            "be the same in both logs",
            "Put one of them into the order of the other.",
        )
    return first or second
