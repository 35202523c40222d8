"""Logs on disk and as labelled arrays: a folder of CSV files, an xarray Dataset."""

import csv
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from perfcontrol._checks import fail

Contents = tuple[Any, Any, Any, Any, Any]  # x, u, deployed, names of states and inputs, as `Logs` takes them

EPISODES, POLICIES = "episodes.csv", "policies.csv"


def to_csv(logs: Any, folder: Path) -> None:
    """See `Logs.to_csv`."""
    if folder.exists():
        raise fail("folder", f"{folder}, which exists", "be new", "Remove it or choose another name.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        _write(logs, temporary)
        temporary.chmod(0o755)  # mkdtemp makes folders private; logs are for everyone whom the folder is for
        os.rename(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write(logs: Any, folder: Path) -> None:
    states = list(logs.state_names or _numbered("x", logs.state_size))
    inputs = list(logs.input_names or _numbered("u", logs.input_size))
    width = len(str(len(logs) - 1))
    names = [f"episode_{e:0{width}d}.csv" for e in range(len(logs))]
    for name, x, u in zip(names, logs.x, logs.u, strict=True):
        blank = [[""] * logs.input_size] * (len(x) - len(u))
        rows = zip(range(len(x)), x.tolist(), u.tolist() + blank, strict=True)
        _write_rows(folder / name, ["t", *states, *inputs], [[t, *x_t, *u_t] for t, x_t, u_t in rows])
    _write_rows(folder / EPISODES, ["file", "policy"], zip(names, logs.deployment.tolist(), strict=True))
    _write_rows(
        folder / POLICIES,
        ["policy", "lag", "input", *states],
        [
            [g, lag + 1, inputs[i], *row.tolist()]
            for g, policy in enumerate(logs.policies)
            for lag, matrix in enumerate(policy)
            for i, row in enumerate(matrix)
        ],
    )


def _numbered(letter: str, count: int) -> list[str]:
    return [f"{letter}{i}" for i in range(count)]


def _write_rows(path: Path, header: list[str], rows: Any) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def from_csv(folder: Path) -> Contents:
    """What `Logs.from_csv` makes logs of."""
    if not folder.is_dir():
        raise fail(
            "folder",
            str(folder),
            "be a folder of logs",
            f"Name one that holds {EPISODES}, {POLICIES} and the episodes.",
        )
    names, index = _read(folder / EPISODES, ["file", "policy"], ["file"])
    text, table = _read(folder / POLICIES, ["policy", "lag", "input"], ["input"])
    policies = _policies(folder / POLICIES, table)
    states = [column for column in _header(folder / POLICIES) if column not in ("policy", "lag", "input")]
    named = list(dict.fromkeys(text["input"]))
    x, u, deployed = [], [], []
    for name, (policy,) in zip(names["file"], index[:, :1], strict=True):
        if policy not in policies:
            raise fail(EPISODES, f"policy {policy:g}", f"name policies of {POLICIES}", "Add its rows there.")
        x_e, u_e = _read_episode(folder / name, states, named)
        x.append(x_e)
        u.append(u_e)
        deployed.append(policies[policy])
    shapes = {policy.shape for policy in deployed}
    if len(shapes) > 1:
        raise fail(POLICIES, f"policies of shapes {sorted(shapes)}", "be all of one shape", "Fill lags with zeros.")
    if not deployed:
        return [], [], [], None, None
    return x, u, np.stack(deployed), _unless_numbered("x", states), _unless_numbered("u", named)


def _unless_numbered(letter: str, names: list[str]) -> list[str] | None:
    return None if names == _numbered(letter, len(names)) else names


def _header(path: Path) -> list[str]:
    with path.open(newline="", encoding="utf-8") as file:
        return [column.strip() for column in next(csv.reader(file))]


def _read(path: Path, required: list[str], text: list[str]) -> tuple[dict[str, list[str]], np.ndarray]:
    """The text columns by name, and all others as numbers; a blank is NaN."""
    name = path.name
    if not path.is_file():
        raise fail(name, "no such file", "exist in the folder", f"Add it: looked for {path}.")
    with path.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if row]
    header = [column.strip() for column in rows[0]] if rows else []
    missing = [column for column in required if column not in header]
    if missing:
        raise fail(name, f"the header {header}", f"have the columns {required}", f"Add {', '.join(missing)}.")
    for line, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise fail(
                name,
                f"{len(row)} cells in line {line}",
                f"have {len(header)} cells a line",
                "Give that line as many cells as the header.",
            )
    labels = {column: [row[header.index(column)] for row in rows[1:]] for column in text}
    numeric = [column for column in header if column not in text]
    numbers = np.empty((len(rows) - 1, len(numeric)))
    for i, row in enumerate(rows[1:]):
        for j, column in enumerate(numeric):
            cell = row[header.index(column)].strip()
            try:
                numbers[i, j] = float(cell) if cell else np.nan
            except ValueError as error:
                raise fail(
                    name,
                    f"{cell!r} in line {i + 2}, column {column}",
                    "hold numbers",
                    "Write a number there, such as 0.5.",
                ) from error
    return labels, numbers


def _policies(path: Path, table: np.ndarray) -> dict[float, np.ndarray]:
    """Policies by their number; rows are sorted by policy, lag and input as written."""
    found: dict[float, np.ndarray] = {}
    for policy in dict.fromkeys(table[:, 0].tolist()):
        rows = table[table[:, 0] == policy]
        lags = rows[:, 1]
        count = int(np.sum(lags == 1))
        if count == 0 or not np.array_equal(lags, np.repeat(np.arange(1, len(rows) // count + 1), count)):
            got = f"lags {lags.tolist()} of policy {policy:g}"
            raise fail(path.name, got, "list lag 1, 2, ... with every input", "Write one row for each lag and input.")
        found[policy] = rows[:, 2:].reshape(-1, count, rows.shape[1] - 2)
    return found


def _read_episode(path: Path, states: list[str], inputs: list[str]) -> tuple[np.ndarray, np.ndarray]:
    _, numbers = _read(path, ["t", *states, *inputs], [])
    header = _header(path)
    t = numbers[:, header.index("t")]
    if len(t) > 1 and not np.all(np.diff(t) == 1):
        line = int(np.argmax(np.diff(t) != 1)) + 2
        got = f"t = {t[line - 2]:g} then {t[line - 1]:g} in line {line + 1}"
        raise fail(path.name, got, "have consecutive times", "Cut the episode at the gap.")
    x, u = (numbers[:, [header.index(name) for name in names]] for names in (states, inputs))
    return x, u[:-1] if len(u) and np.all(np.isnan(u[-1])) else u


def to_dataset(logs: Any) -> Any:
    """See `Logs.to_dataset`."""
    import xarray

    length = max(len(x) for x in logs.x)

    def padded(episodes: tuple[np.ndarray, ...]) -> np.ndarray:
        out = np.full((len(episodes), length, episodes[0].shape[1]), np.nan)
        for row, episode in zip(out, episodes, strict=True):
            row[: len(episode)] = episode
        return out

    return xarray.Dataset(
        {
            "x": (("episode", "time", "state"), padded(logs.x)),
            "u": (("episode", "time", "input"), padded(logs.u)),
            "deployed": (("episode", "lag", "input", "state"), logs.deployed),
            "transitions": (("episode",), np.array([len(x) - 1 for x in logs.x])),
            "deployment": (("episode",), logs.deployment),
        },
        coords={"lag": np.arange(1, logs.memory + 1), **labels(logs)},
    )


def labels(logs: Any) -> dict[str, Any]:
    """Coordinates of the dimensions state and input, where the signals have names."""
    named = {"state": logs.state_names, "input": logs.input_names}
    return {dim: list(names) for dim, names in named.items() if names is not None}


def from_dataset(dataset: Any) -> Contents:
    """What `Logs.from_dataset` makes logs of."""
    missing = [name for name in ("x", "u", "deployed") if name not in dataset]
    if missing:
        raise fail(
            "dataset",
            f"no {', '.join(missing)}",
            "hold x, u and deployed",
            "Name its variables as `Logs.to_dataset` does.",
        )
    axes = {
        "x": ("episode", "time", "state"),
        "u": ("episode", "time", "input"),
        "deployed": ("episode", "lag", "input", "state"),
    }
    for name, dims in axes.items():
        if set(dataset[name].dims) != set(dims):
            got = f"{name} over {tuple(dataset[name].dims)}"
            raise fail("dataset", got, f"hold {name} over {dims}", "Rename its dimensions.")
    x, u, deployed = (dataset[name].transpose(*dims).values for name, dims in axes.items())
    states, controls = _named(dataset, "state"), _named(dataset, "input")
    if "transitions" not in dataset:
        return x, u, deployed, states, controls
    lengths = dataset["transitions"].values.astype(int).tolist()
    inputs = [_trimmed(row[: length + 1], length) for row, length in zip(u, lengths, strict=True)]
    return [row[: length + 1] for row, length in zip(x, lengths, strict=True)], inputs, deployed, states, controls


def _named(dataset: Any, dimension: str) -> list[str] | None:
    names = dataset[dimension].values.tolist() if dimension in dataset.coords else []
    return names if names and isinstance(names[0], str) else None


def _trimmed(inputs: np.ndarray, length: int) -> np.ndarray:
    """Without the input of the last state where that was not logged."""
    return inputs[:length] if np.all(np.isnan(inputs[length:])) else inputs
