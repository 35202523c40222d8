"""Every claim of the paper's numerical section, judged by a rule on the data."""

import xarray

from perfcontrol.config import ReproduceSettings
from perfcontrol.reports.claims import Claim
from perfcontrol.reports.paper import divergence, regimes, theorems


def judge(
    exact: xarray.Dataset,
    exact_bounded: xarray.Dataset | None,
    optimum: xarray.Dataset,
    runs: xarray.Dataset,
    cure: xarray.Dataset,
    sweep: xarray.Dataset,
    settings: ReproduceSettings,
) -> list[Claim]:
    """All claims, in the order in which the paper makes them; then what the paper does not say.

    `exact_bounded` is None where the simplex was not run.
    """
    return [
        regimes.error_decays(runs, "stable"),
        regimes.inverse_rate(runs, settings),
        regimes.cost_converges(runs, "stable", "Figure 2 left"),
        regimes.order_is_negligible(runs),
        regimes.iterates_diverge(runs),
        regimes.cost_is_larger(runs),
        regimes.ascending_survives(runs),
        theorems.existence(exact, exact_bounded),
        regimes.error_decays(runs, "general"),
        regimes.cost_converges(runs, "general", "Figure 2 right"),
        theorems.theorem(cure, settings),
        theorems.backward_decay(cure),
        divergence.onset(sweep),
        divergence.smaller_step(cure),
        *([] if exact_bounded is None else [divergence.bounded_set(cure)]),
        regimes.stable_is_not_optimal(runs),
        theorems.price_of_stability(exact, optimum),
        theorems.as_printed(exact),
    ]
