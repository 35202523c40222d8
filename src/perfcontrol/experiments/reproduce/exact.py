"""Stable points of all cases without sampling, and what repeated minimisation makes of them."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
import xarray

from perfcontrol.config import ReproduceSettings
from perfcontrol.evaluate.exact import expected_cost
from perfcontrol.experiments.reproduce.cases import Progress, by_case, problems_of, starts_of
from perfcontrol.experiments.stock import STOCKS
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import RRM, StablePoint, solve

STARTS = 4  # further starts of the exact solver in each case


def exact_stage(problems: list[PerformativeProblem], settings: ReproduceSettings, progress: Progress) -> xarray.Dataset:
    """Stable points of all cases without sampling, with the evidence that they are such and the only ones."""
    rows: dict[str, list[Any]] = {name: [] for name in ("M", "residual", "unique", "spread")}
    for index, problem in enumerate(problems):
        stable = solve(problem, StablePoint(), throw=False)
        M = np.asarray(stable.M)
        others = [
            np.asarray(solve(problem, StablePoint(), start, throw=False).M)
            for start in starts_of(settings, problem, STARTS)
        ]
        rows["M"].append(M[0])
        rows["residual"].append(float(stable.stats["residual"]))
        rows["unique"].append(bool(stable.stats["unique"]))
        rows["spread"].append(max(float(np.linalg.norm(other - M)) for other in others) / float(np.linalg.norm(M)))
        progress("exact stable points", (index + 1) / len(problems))
    return by_case(rows)


def repeated_minimisation(
    problems: list[PerformativeProblem], exact: xarray.Dataset, settings: ReproduceSettings
) -> xarray.Dataset:
    """`exact` with repeated minimisation beside it: where it ends from afar, how fast it contracts; exact costs.

    And with the volatility as printed: how much of anything still depends on the policy.
    """
    rows: dict[str, list[Any]] = {name: [] for name in ("rate", "agreement", "cost")}
    starts = starts_of(settings, problems[0], 2)
    project = jax.jit(lambda problem, M: problem.feasible_set.project(M))
    for problem, M in zip(problems, exact["M"].values.reshape(len(problems), 1, STOCKS, STOCKS), strict=True):
        # A start a hundred portfolios away, to see that it contracts.
        repeated = solve(problem, RRM(), project(problem, 100 * starts[0]), throw=False)
        rate = float(repeated.stats["rate"])
        rows["rate"].append(rate if np.isfinite(rate) else 0.0)  # converged at once: no ratio to take
        rows["agreement"].append(float(np.linalg.norm(np.asarray(repeated.M) - M) / np.linalg.norm(M)))
        rows["cost"].append(float(expected_cost(problem, M)))
    perturbation: Any = problems_of(settings, settings.feasible_set, "as_printed")[0].perturbation
    growth = perturbation.growth
    # Exact evaluation sees a perturbation's moments alone: those as printed, in the program that is compiled already.
    printed = eqx.tree_at(
        lambda p: (p.perturbation.growth.first_moment, p.perturbation.growth.variance),
        problems[0],
        (growth.first_moment, growth.variance),
    )
    ends = [solve(printed, RRM(), start, throw=False) for start in starts]
    responses = [np.asarray(end.history[1]) for end in ends]
    return exact.merge(by_case(rows)).assign(
        printed_variance=float(np.max(np.abs(np.asarray(growth.variance)))),
        printed_steps=max(int(end.steps) for end in ends),
        printed_difference=float(np.max(np.abs(responses[0] - responses[1]))),
    )
