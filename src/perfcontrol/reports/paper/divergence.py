"""Why runs diverge, and what cures it: not in the paper."""

import numpy as np
import xarray

from perfcontrol.reports.claims import Claim, bootstrap, median
from perfcontrol.reports.paper.statistics import listed, orders, worst


def share_that_left(sweep: xarray.Dataset) -> xarray.DataArray:
    """Share of the seeds whose error grew tenfold or that were stopped: more than a noise floor above the start."""
    return ((sweep["relative_error"] > 10) | (sweep["result"] != "success")).mean("seed")


def onset(sweep: xarray.Dataset) -> Claim:
    """Divergence begins at the mean-square threshold."""
    share = share_that_left(sweep)
    onsets, texts = {}, {}
    for order in orders(sweep):
        beyond = share.sel(order=order).values >= 0.5
        factors = sweep["factor"].values
        onsets[order] = float(factors[beyond][0]) if beyond.any() else float("nan")
        texts[order] = f"{order} at {onsets[order]:.3g} of {float(sweep['threshold'].sel(order=order)):.4f}"
    known = [value for value in onsets.values() if np.isfinite(value)]
    low, high = (min(known), max(known)) if known else (0.0, 0.0)
    near = len(known) == len(onsets) and low >= 0.5 and high <= 2.0
    return Claim(
        "The divergence comes from the constant step: it begins where RSGD loses mean-square stability",
        "not in the paper",
        "step at which half of the seeds end ten times farther away than they began, over the mean-square threshold: "
        "smallest and largest of the three orders",
        (low + high) / 2,
        (low, high),
        "holds if the onset lies between 0.5 and 2 thresholds for every order",
        "holds" if near else "does not hold",
        f"Unstable regime, onset of divergence: {'; '.join(texts.values())}. The paper's 0.01 lies above the threshold "
        "of the random and the descending order and below that of the ascending one: exactly the two that diverge.",
    )


def smaller_step(cure: xarray.Dataset) -> Claim:
    """What a ten times smaller constant step does."""
    values, floors, over = {}, {}, {}
    for order in orders(cure):
        rows = cure["smaller"].sel(order=order).values
        values[order] = bootstrap(rows[:, -1] / rows[:, 0], median)
        floors[order] = float(cure["floor_smaller"].sel(order=order))
        over[order] = float(np.mean(rows[:, -(rows.shape[1] // 4) :])) / floors[order]
    name, value, interval = worst(values)
    return Claim(
        "A ten times smaller constant step ends the divergence, on a floor",
        "not in the paper",
        f"unstable regime, median of the final over the first error, worst order ({name})",
        value,
        interval,
        "holds if the interval lies below 1 for every order",
        "holds" if interval[1] < 1 else "does not hold",
        f"Final over first error: {listed(values)}. It is no cure: a constant step keeps the error on its mean-square "
        f"floor, by theory {listed(floors)}; mean error over the last quarter of the runs, relative to it: "
        f"{listed(over)}. A diminishing step has no floor.",
    )


def bounded_set(cure: xarray.Dataset) -> Claim:
    """The simplex keeps the iterates bounded."""
    values = {}
    for order in orders(cure):
        rows = cure["simplex"].sel(order=order).values
        values[order] = bootstrap(np.max(rows, axis=1), np.max)
    name, value, interval = worst(values)
    ends = {order: float(np.median(cure["simplex"].sel(order=order).values[:, -1])) for order in orders(cure)}
    return Claim(
        "On the simplex (nonnegative weights, as Example 1 has them) the iterates stay bounded at the paper's step",
        "Appendix A, Example 1",
        f"unstable regime, largest squared error of any iterate of any seed, worst order ({name})",
        value,
        interval,
        "holds if the interval lies below 10",
        "holds" if interval[1] < 10 else "does not hold",
        f"Median last error to the simplex's own M^PS: {listed(ends)}. The simulation's set fixes the row sums alone; "
        "there M^PS has negative weights.",
    )
