"""Trajectories: what states and inputs do under each policy, in the middle and in most cases."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from perfcontrol._checks import fail
from perfcontrol.evaluate import Trajectories
from perfcontrol.plotting.style import Look, looks, styled
from perfcontrol.plotting.subjects import as_paths, input_names, panels, plain, state_names
from perfcontrol.problem import PerformativeProblem

MOST = 6  # signals shown unless they are named
STEPS = 400  # drawn at most


def plot_trajectories(
    problem: PerformativeProblem,
    policies: Any,
    *,
    key: Any = None,
    samples: int = 512,
    signals: Sequence[str] | str | None = None,
    band: float = 0.9,
    truncation: int | None = None,
    ax: Any = None,
) -> np.ndarray:
    """States and inputs over time under each policy in the world that it makes: the median, and the band of most paths.

    Of more than 400 time steps so many are drawn, evenly spaced.

    Args:
        problem: the problem.
        policies: by name, {"stable": M}; `pc.price_of_stability(problem)` for naive, stable and optimal; one policy or
            solution; or `pc.simulate(...)` in place of a policy, where it is not deployed itself.
        key: JAX random key; required unless all paths are given.
        samples: paths of each policy.
        signals: names of states and inputs, those of the system or x[0], ..., u[0], ...; None for all, where there are
            more than six for those that vary most.
        band: share of the paths inside the band.
        truncation: time steps shown of an infinite horizon; None for 100.
        ax: as many Matplotlib axes as signals; None makes a figure.

    Returns:
        The axes, as an array, one a signal.

    Raises:
        InputError: as `pc.simulate`; unknown signals; another number of axes; a band outside (0, 1).
    """
    if not 0 < band < 1:
        raise fail(
            "band",
            f"{band}",
            "lie between 0 and 1",
            "Pass for example 0.9, which leaves a twentieth of the paths out on either side.",
        )
    paths = as_paths(problem, policies, key, samples, truncation)
    chosen = chosen_signals(problem, paths, signals)
    styles = looks(paths)
    with styled():
        drawn = panels(ax, len(chosen))
        for axes, name in zip(drawn, chosen, strict=True):
            for policy, simulated in paths.items():
                _signal(axes, signal(problem, simulated, name), band, policy, styles[policy])
            axes.set_title(plain(name))
            axes.set_xlabel("time $t$")
            axes.margins(x=0)
        if ax is None and len(paths) > 1:
            drawn[0].figure.legend(  # type: ignore[union-attr]
                *drawn[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(paths)
            )
    return np.asarray(drawn, dtype=object)


def _signal(axes: Axes, values: np.ndarray, band: float, policy: str, look: Look) -> None:
    low, middle, high = np.quantile(values, [(1 - band) / 2, 0.5, (1 + band) / 2], axis=0)
    t = np.unique(np.linspace(0, len(middle) - 1, min(len(middle), STEPS)).astype(int))
    low, middle, high = low[t], middle[t], high[t]
    axes.fill_between(t, low, high, color=look.colour, alpha=0.07, linewidth=0)
    axes.plot(t, middle, color=look.colour, linestyle=look.line, linewidth=1.1, label=plain(policy))
    for edge in (low, high):  # shades that lie over one another tell nobody apart
        axes.plot(t, edge, color=look.colour, linestyle=look.line, linewidth=0.9)


def signal(problem: PerformativeProblem, paths: Trajectories, name: str) -> np.ndarray:
    """One state or input of all paths, (samples, T+1)."""
    states, inputs = state_names(problem), input_names(problem)
    if name in states:
        return np.asarray(paths.x)[..., states.index(name)]
    return np.asarray(paths.u)[..., inputs.index(name)]


def chosen_signals(
    problem: PerformativeProblem, paths: dict[str, Trajectories], signals: Sequence[str] | str | None
) -> list[str]:
    """The signals asked for; by default all, or those of the largest mean square where there are many.

    Raises:
        InputError: an unknown name.
    """
    known = [*state_names(problem), *input_names(problem)]
    if signals is None:
        if len(known) <= MOST:
            return known
        size = {name: max(np.mean(signal(problem, one, name) ** 2) for one in paths.values()) for name in known}
        largest = sorted(known, key=lambda name: -size[name])[:MOST]
        return [name for name in known if name in largest]
    asked = [signals] if isinstance(signals, str) else list(signals)
    for name in asked:
        if name not in known:
            listed = ", ".join(known[:8]) + (", ..." if len(known) > 8 else "")
            raise fail("signals", repr(name), "be names of states and inputs", f"Choose from {listed}.")
    return asked
