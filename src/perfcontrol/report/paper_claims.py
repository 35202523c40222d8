"""The statements of the paper's section "Numerical Experiments", and of its theorem and propositions as far as the
experiment can show them, each judged by a rule on the data."""

from typing import Any

import numpy as np
import xarray

from perfcontrol.config import ReproduceSettings
from perfcontrol.report.claims import Claim, Verdict, bootstrap, loglog_slope, wilson

SECTION = "Numerical Experiments"
FAR_ORDERS = ("descending", "random")


def judge(
    exact: xarray.Dataset,
    exact_bounded: xarray.Dataset | None,
    runs: xarray.Dataset,
    cure: xarray.Dataset,
    sweep: xarray.Dataset,
    settings: ReproduceSettings,
) -> list[Claim]:
    """All claims, in the order in which the paper makes them; then what the paper does not say.

    `exact_bounded` is None where the simplex was not run.
    """
    return [
        _decays(runs, "stable"),
        _inverse_rate(runs, settings),
        _cost_converges(runs, "stable", "Figure 2 left"),
        _order_negligible(runs),
        _diverge(runs),
        _cost_larger(runs),
        _ascending_survives(runs),
        _existence(exact, exact_bounded),
        _decays(runs, "general"),
        _cost_converges(runs, "general", "Figure 2 right"),
        _theorem(cure, settings),
        _backward_decay(cure),
        _onset(sweep),
        _smaller_step(cure),
        *([] if exact_bounded is None else [_bounded_set(cure)]),
        _stable_is_not_optimal(runs),
        _as_printed(exact),
    ]


def _worst(values: dict[str, tuple[float, tuple[float, float]]]) -> tuple[str, float, tuple[float, float]]:
    """The order with the largest statistic: a claim about all orders stands or falls with it."""
    name = max(values, key=lambda order: values[order][0])
    return name, *values[name]


def _listed(values: dict[str, Any]) -> str:
    """ "ascending 0.1, descending 0.2, ..."."""
    return ", ".join(
        f"{order} {value[0] if isinstance(value, tuple) else value:.3g}" for order, value in values.items()
    )


def _relative_error(runs: xarray.Dataset, regime: str, order: str) -> np.ndarray:
    """Final over initial squared error of each seed."""
    error = runs["error"].sel(regime=regime, order=order).values
    return error[:, -1] / error[:, 0]


def _orders(dataset: xarray.Dataset) -> list[str]:
    return [str(order) for order in dataset["order"].values]


def _decays(runs: xarray.Dataset, regime: str) -> Claim:
    values = {order: bootstrap(_relative_error(runs, regime, order), np.median) for order in _orders(runs)}
    name, value, interval = _worst(values)
    share = {order: float(np.mean(_relative_error(runs, regime, order) < 1)) for order in values}
    panel = {"stable": "left", "general": "right"}[regime]
    text = {
        "stable": "In the almost surely strongly stable regime the PS error decays for all three orders",
        "general": "In the general regime all three orders converge",
    }[regime]
    return Claim(
        text,
        f"{SECTION}, Figure 1 {panel}",
        f"median over seeds of the final over the initial PS error, worst order ({name})",
        value,
        interval,
        "holds as completed if the interval lies below 1",
        "holds as completed" if interval[1] < 1 else "does not hold",
        f"Final over initial error: {_listed(values)}; share of seeds that came closer: {_listed(share)}. "
        "Completed: the growth factor of the regime, q_1, r, h, the log-normal volatility and the step on the stage "
        "average are ours.",
    )


def _inverse_rate(runs: xarray.Dataset, settings: ReproduceSettings) -> Claim:
    steps = runs["step"].values
    window = np.unique(np.geomspace(max(steps[-1] // 4, 10), steps[-1], 40).astype(int))

    def slope(rows: np.ndarray) -> float:
        return loglog_slope(window, np.median(rows[:, window], axis=0))

    values = {
        order: bootstrap(runs["error"].sel(regime="stable", order=order).values, slope) for order in _orders(runs)
    }
    name, value, interval = _worst(values)
    return Claim(
        "In the stable regime the PS error decays like 1/N as N grows",
        f"{SECTION}, Figure 1 left; Theorem 1",
        f"slope of log median error against log n over the last quarter to the end, slowest order ({name})",
        value,
        interval,
        "holds if the slope's interval lies below -0.9 for every order",
        "holds" if interval[1] < -0.9 else "does not hold",
        f"Slopes: {_listed(values)}. With the paper's constant step {settings.step_size} the error falls "
        "fast at first and then ends on a floor that is proportional to the step; Theorem 1 promises 1/N for a "
        "diminishing step only, and there it is seen (below).",
    )


def _cost_converges(runs: xarray.Dataset, regime: str, panel: str) -> Claim:
    quarter = runs.sizes["step"] // 4

    def drift(rows: np.ndarray) -> float:
        middle = np.median(rows, axis=0)
        return abs(np.mean(middle[-quarter:]) - np.mean(middle[-2 * quarter : -quarter])) / np.ptp(middle)

    values, levels = {}, {}
    for order in _orders(runs):
        cost = runs["cost"].sel(regime=regime, order=order).values
        values[order] = bootstrap(cost, drift)
        stable = float(runs["stable_cost"].sel(regime=regime, order=order))
        levels[order] = float(np.mean(np.median(cost, axis=0)[-quarter:])) / stable
    name, value, interval = _worst(values)
    return Claim(
        f"In the {regime} regime the expected total cost converges",
        f"{SECTION}, {panel}",
        "change of the median C_T(M_n; M_n) from the third to the last quarter of the run, over its whole range, worst "
        f"order ({name})",
        value,
        interval,
        "holds as completed if the interval lies below 0.1: the cost has settled",
        "holds as completed" if interval[1] < 0.1 else "does not hold",
        f"Changes: {_listed(values)}. Level on which it settles, over C_T(M^PS; M^PS): {_listed(levels)}: a constant "
        "step leaves a noise floor above the cost of the stable policy. Completions as in the first row.",
    )


def _order_negligible(runs: xarray.Dataset) -> Claim:
    ends = {order: _relative_error(runs, "stable", order) for order in _orders(runs)}
    stacked = np.stack(list(ends.values()), axis=1)

    def spread(rows: np.ndarray) -> float:
        medians = np.median(rows, axis=0)
        return float(medians.max() - medians.min())

    value, interval = bootstrap(stacked, spread)
    ratio = np.median(stacked, axis=0).max() / np.median(stacked, axis=0).min()
    return Claim(
        "In the stable regime the temporal order of the sensitivities is negligible",
        SECTION,
        "largest difference between orders of the median final error, relative to the initial error",
        value,
        interval,
        "holds as completed if the interval lies below 0.05: the orders differ by less than 5 % of the way to go",
        "holds as completed" if interval[1] < 0.05 else "does not hold",
        f"Final over initial error: {_listed({k: float(np.median(v)) for k, v in ends.items()})}: negligible beside "
        "the "
        f"error removed, yet the floors differ by a factor of {ratio:.1f}, larger where the large sensitivities come "
        "first.",
    )


def _diverge(runs: xarray.Dataset) -> Claim:
    outcomes, trials = {}, runs.sizes["seed"]
    for order in _orders(runs):
        away = _relative_error(runs, "unstable", order) > 1
        outcomes[order] = wilson(int(away.sum()), trials)
    name = min(FAR_ORDERS, key=lambda order: outcomes[order][0])
    value, interval = outcomes[name]
    ended = {
        order: int((runs["result"].sel(regime="unstable", order=order) != "success").sum()) for order in _orders(runs)
    }
    return Claim(
        "In the unstable regime the iterates diverge for the descending and the random order",
        f"{SECTION}, Figure 1 middle",
        f"share of seeds whose final error exceeds the initial one, lower of the two orders ({name})",
        value,
        interval,
        "holds as completed if the interval lies above one half for both orders",
        "holds as completed" if interval[0] > 0.5 else "does not hold",
        f"Shares: {_listed(outcomes)}; runs stopped as divergent, of {trials}: {_listed(ended)}. The cause is the "
        "constant step, not a missing stable policy (below).",
    )


def _cost_larger(runs: xarray.Dataset) -> Claim:
    last = {order: runs["cost"].sel(regime="unstable", order=order).values[:, -1] for order in _orders(runs)}

    def ratio(rows: np.ndarray) -> float:
        return float(min(np.median(rows[:, 1]), np.median(rows[:, 2])) / np.median(rows[:, 0]))

    value, interval = bootstrap(np.stack([last["ascending"], last["descending"], last["random"]], axis=1), ratio)
    return Claim(
        "In the unstable regime the costs of the descending and the random order are significantly larger than that "
        "of the ascending one",
        f"{SECTION}, Figure 2 middle",
        "smaller of the two medians of the last cost over the ascending median",
        value,
        interval,
        "holds as completed if the interval lies above 1.5",
        "holds as completed" if interval[0] > 1.5 else "does not hold",
        f"Median last cost (of the last iterate kept): {_listed({k: float(np.median(v)) for k, v in last.items()})}.",
    )


def _ascending_survives(runs: xarray.Dataset) -> Claim:
    value, interval = bootstrap(_relative_error(runs, "unstable", "ascending"), np.median)
    return Claim(
        "In the unstable regime the ascending order alone converges",
        f"{SECTION}, Figure 1 middle (implied)",
        "median of the final over the initial PS error",
        value,
        interval,
        "holds as completed if the interval lies below 1",
        "holds as completed" if interval[1] < 1 else "does not hold",
        "It comes closer, slowly: its step is just below the mean-square threshold (below).",
    )


def _existence(exact: xarray.Dataset, bounded: xarray.Dataset | None) -> Claim:
    sets = [exact] if bounded is None else [exact, bounded]
    residual, spread = (max(float(found[name].max()) for found in sets) for name in ("residual", "spread"))
    unique = all(bool(found["unique"].all()) for found in sets)
    where = "the feasible set" if bounded is None else "both sets"
    found = residual <= 1e-11 and unique and spread <= 1e-8
    verdict: Verdict = "does not hold" if found else "holds"
    return Claim(
        "Large initial sensitivities rule out the existence of M^PS (unstable regime, descending and random)",
        f"{SECTION}; Proposition 2",
        "largest relative natural residual of the exact stable policies, all nine cases on " + where,
        residual,
        (residual, residual),
        "does not hold if every case has a stable policy (residual at most 1e-11), a unique best response, and the "
        "same point from every start",
        verdict,
        f"M^PS exists in all nine cases, with residuals of at most {residual:.1e}; further starts end within "
        f"{spread:.1e} of it; repeated minimisation reaches the same point "
        f"(relative difference at most {float(exact['agreement'].max()):.1e}) and contracts at "
        f"{float(exact['rate'].min()):.1e} to {float(exact['rate'].max()):.1e} per step. Proposition 2 is about the "
        "sufficient condition, and says nothing on existence.",
    )


def _theorem(cure: xarray.Dataset, settings: ReproduceSettings) -> Claim:
    steps = cure["step_diminishing"].values
    window = np.unique(np.geomspace(max(steps[-1] // 10, 10), steps[-1], 40).astype(int)) - 1

    def slope(rows: np.ndarray) -> float:
        return loglog_slope(steps[window], np.median(rows[:, window], axis=0))

    values = {order: bootstrap(cure["diminishing"].sel(order=order).values, slope) for order in _orders(cure)}
    name, value, interval = _worst(values)
    ends = {order: float(np.median(cure["diminishing"].sel(order=order).values[:, -1])) for order in _orders(cure)}
    return Claim(
        "With a step that diminishes like 1/n the mean-square error decays like 1/N",
        "Theorem 1",
        f"unstable regime, slope of log median error against log n over the last decade, slowest order ({name})",
        value,
        interval,
        "holds if the interval lies below -0.7 for every order: near -1, the transient still in it",
        "holds" if interval[1] < -0.7 else "does not hold",
        f"Slopes: {_listed(values)}; median error after {int(steps[-1])} steps: {_listed(ends)}. So all three orders "
        f"reach the exact M^PS in the regime where a constant step diverges; the step is "
        f"{settings.step_size}·10/(n + 10) on the stage average.",
    )


def _backward_decay(cure: xarray.Dataset) -> Claim:
    rows = cure["diminishing"].sel(order="descending").values
    value, interval = bootstrap(rows[:, -1] / rows[:, 0], np.median)
    return Claim(
        "In the unstable regime sensitivities must decay backward in time for M^PS to be reached",
        "Proposition 2, as Section Numerical Experiments reads it",
        "descending order, diminishing step: median of the final over the first error",
        value,
        interval,
        "does not hold if the interval lies below 1: the order that decays the wrong way converges all the same",
        "does not hold" if interval[1] < 1 else "holds",
        "Proposition 2 gives a necessary property of a sufficient condition. The descending order violates it, and "
        "RSGD converges to M^PS once the step diminishes.",
    )


def share_that_left(sweep: xarray.Dataset) -> xarray.DataArray:
    """Share of the seeds whose error grew tenfold or that were stopped: more than a noise floor above the start."""
    return ((sweep["relative_error"] > 10) | (sweep["result"] != "success")).mean("seed")


def _onset(sweep: xarray.Dataset) -> Claim:
    share = share_that_left(sweep)
    onsets, texts = {}, {}
    for order in _orders(sweep):
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


def _smaller_step(cure: xarray.Dataset) -> Claim:
    values = {}
    for order in _orders(cure):
        rows = cure["smaller"].sel(order=order).values
        values[order] = bootstrap(rows[:, -1] / rows[:, 0], np.median)
    name, value, interval = _worst(values)
    return Claim(
        "A ten times smaller constant step cures the divergence",
        "not in the paper",
        f"unstable regime, median of the final over the first error, worst order ({name})",
        value,
        interval,
        "holds if the interval lies below 1 for every order",
        "holds" if interval[1] < 1 else "does not hold",
        f"Final over first error: {_listed(values)}.",
    )


def _bounded_set(cure: xarray.Dataset) -> Claim:
    values = {}
    for order in _orders(cure):
        rows = cure["simplex"].sel(order=order).values
        values[order] = bootstrap(np.max(rows, axis=1), np.max)
    name, value, interval = _worst(values)
    ends = {order: float(np.median(cure["simplex"].sel(order=order).values[:, -1])) for order in _orders(cure)}
    return Claim(
        "On the simplex (nonnegative weights, as Example 1 has them) the iterates stay bounded at the paper's step",
        "Appendix A, Example 1",
        f"unstable regime, largest squared error of any iterate of any seed, worst order ({name})",
        value,
        interval,
        "holds if the interval lies below 10",
        "holds" if interval[1] < 10 else "does not hold",
        f"Median last error to the simplex's own M^PS: {_listed(ends)}. The simulation's set fixes the row sums alone; "
        "there M^PS has negative weights.",
    )


def _stable_is_not_optimal(runs: xarray.Dataset) -> Claim:
    ratios = {}
    for regime in runs["regime"].values:
        for order in _orders(runs):
            picked = runs.sel(regime=regime, order=order)
            ratios[f"{regime}/{order}"] = float(picked["stable_cost"] / picked["cost"].min())
    name = max(ratios, key=lambda case: ratios[case])
    return Claim(
        "Converging to M^PS lowers the expected total cost",
        f"{SECTION}, Figure 2 (as a reader may take it)",
        f"C_T(M^PS; M^PS) over the lowest cost of any iterate on the way, worst case ({name})",
        ratios[name],
        (min(ratios.values()), max(ratios.values())),
        "does not hold if the ratio exceeds 1.05 in some case; the interval spans the nine cases",
        "does not hold" if ratios[name] > 1.05 else "holds",
        f"Stable is not optimal: the ratios are {_listed(ratios)}. Where large sensitivities come first, the way to "
        "the "
        "stable policy leads past cheaper ones.",
    )


def _as_printed(exact: xarray.Dataset) -> Claim:
    value, difference = float(exact["printed_variance"]), float(exact["printed_difference"])
    nothing = value < 1e-10 and difference < 1e-9
    return Claim(
        "With v ~ N(log ε_t, 0.2) clipped to [-0.6, 0.6] the sensitivities ε_t set how the dynamics see the policy",
        "Appendix A, simulation paragraph",
        "largest variance of the day's growth, volatility as printed",
        value,
        (value, value),
        "does not hold if the variance is below 1e-10 and the best response is the same from every deployed policy",
        "does not hold" if nothing else "holds",
        "As printed log ε_t is at most -2, so v is -0.6 on every day: the growth is a constant, the dynamics do not "
        f"see the policy on the row-sum set, and repeated minimisation ends after {int(exact['printed_steps'])} steps "
        f"whatever the start (best responses differ by {difference:.1e}). Read as log-normal, "
        "v = clip(exp N(log ε_t, 0.2²), -0.6, 0.6), the experiment means what it says.",
    )
