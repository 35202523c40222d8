"""The figures of a report, each with what it shows in words for those who do not see it."""

import functools
import itertools
from collections.abc import Iterator

import numpy as np

from perfcontrol.plotting.certificate import contributions_of, plot_certificate
from perfcontrol.plotting.convergence import plot_convergence
from perfcontrol.plotting.costs import plot_costs
from perfcontrol.plotting.landscape_figure import VIEWS, draw_view
from perfcontrol.plotting.policy import heat_map_size, plot_policy
from perfcontrol.plotting.style import looks
from perfcontrol.plotting.trajectories import chosen_signals, plot_trajectories, signal
from perfcontrol.reports.page.findings import Findings
from perfcontrol.reports.page.markup import Html, text
from perfcontrol.reports.page.svg import NAMES, Drawing, draw
from perfcontrol.theory import Certificate

PANEL = 3.3, 2.3  # inches, readable on a screen 380 pixels wide
BAND = 0.9


class Gallery:
    """Draws figures of one report; each gets the next prefix for its ids."""

    def __init__(self, found: Findings):
        self.found = found
        self.prefixes: Iterator[str] = (f"f{n}" for n in itertools.count(1))

    def convergence(self) -> list[Drawing]:
        """One figure: distances to the stable policy, where there is one, or else to what the first good run found."""
        found = self.found
        stable = found.policies.get("stable")
        parts = []
        for name, run in found.convergence.items():
            last = float(np.linalg.norm(np.asarray(run.M) - (np.asarray(run.M) if stable is None else stable)))
            parts.append(f"{name} after {int(run.steps)} steps at distance {last:.2g}")
        alt = f"Distance to the stable policy against the step, on a logarithmic axis: {'; '.join(parts)}."
        plot = lambda axes: plot_convergence(found.convergence, stable, every=found.every, ax=axes)  # noqa: E731
        return [self._drawn(4.0, 2.8, alt, plot)]

    def policies(self) -> list[Drawing]:
        """A heat map of each policy, all on one scale of colours."""
        found = self.found
        lags, inputs, states = found.problem.lifted_shape
        size = heat_map_size(found.problem)
        lifted = {name: np.asarray(found.problem.lift(M)) for name, M in found.policies.items()}
        limit = max(float(np.max(np.abs(M))) for M in lifted.values()) or None
        drawn = []
        for name, M in lifted.items():
            lag, row, column = np.unravel_index(np.argmax(np.abs(M)), M.shape)
            alt = (
                f"Heat map of the {name} policy, {lags} lags, {inputs} inputs, {states} states. Largest entry "
                f"{M[lag, row, column]:.3g}, of input {row} to the disturbance of state {column} at lag {lag + 1}."
            )
            free = found.policies[name]
            plot = lambda axes, free=free: plot_policy(found.problem, free, limit=limit, ax=axes)  # noqa: E731
            drawn.append(self._drawn(*size, alt, plot))
        return drawn

    def trajectories(self) -> list[Drawing]:
        """One figure a signal."""
        found, drawn = self.found, []
        for name in chosen_signals(found.problem, found.paths, None):
            ends = []
            for policy, paths in found.paths.items():
                low, high = np.quantile(signal(found.problem, paths, name)[:, -1], [(1 - BAND) / 2, (1 + BAND) / 2])
                ends.append(f"from {low:.3g} to {high:.3g} under {policy}")
            alt = f"{name} over time. At the end nine paths in ten lie {'; '.join(ends)}."
            plot = lambda axes, name=name: plot_trajectories(  # noqa: E731
                found.problem, found.paths, signals=name, band=BAND, ax=axes
            )
            drawn.append(self._drawn(*PANEL, alt, plot))
        return drawn

    def costs(self) -> list[Drawing]:
        """One figure."""
        found = self.found
        means = ", ".join(f"{np.mean(np.asarray(paths.cost)):.4g} under {name}" for name, paths in found.paths.items())
        alt = f"Histogram of the cost over {found.samples} simulated paths of each policy. Means: {means}."
        return [self._drawn(4.0, 2.8, alt, lambda axes: plot_costs(found.problem, found.paths, ax=axes))]

    def contributions(self, certificate: Certificate) -> Drawing:
        """One figure."""
        shares = contributions_of(certificate)
        alt = (
            f"What each time adds to the left side of the {certificate.kind} certificate. The "
            f"largest, {np.max(shares):.3g}, comes from t = {int(np.argmax(shares))}; the sum is {certificate.lhs:.4g} "
            f"and must stay below {certificate.rhs:.4g}."
        )
        return self._drawn(*PANEL, alt, lambda axes: plot_certificate(certificate, ax=axes))

    def landscape(self) -> list[Drawing]:
        """Two or three views."""
        price, found = self.found.price, self.found.landscape
        assert price is not None and found is not None
        words = {
            "plane": "Costs of policies on the plane through the stable, the optimal and the naive policy.",
            "worlds": "Costs of policies on the line through the stable and the optimal one, in each other's worlds.",
            "line": "Costs along that line: in each policy's own world, in that of the stable, of the optimal one.",
        }
        ends = f" The stable policy costs {price.cost_stable:.5g}, the optimal one {price.cost_optimal:.5g}."
        views = VIEWS if found.has_plane else VIEWS[1:]
        return [
            self._drawn(3.0, 2.9, words[view] + ends, functools.partial(draw_view, price=price, found=found, view=view))
            for view in views
        ]

    def _drawn(self, width: float, height: float, alt: str, plot: object) -> Drawing:
        return draw(width, height, alt, next(self.prefixes), plot)  # type: ignore[arg-type]


def legend(names: list[str]) -> Html:
    """Names beside the lines that stand for them."""
    parts = []
    for name, look in looks(names).items():
        dashes = "" if look.line == "-" else f' stroke-dasharray="{" ".join(str(2 * n) for n in look.line[1])}"'
        parts.append(
            f'<span><svg viewBox="0 0 40 8" aria-hidden="true"><line x1="0" y1="4" x2="40" y2="4" stroke-width="2.5" '
            f'stroke="{NAMES[look.colour]}"{dashes}/></svg> {text(name)}</span>'
        )
    return Html(f'<p class="legend">{" ".join(parts)}</p>\n')
