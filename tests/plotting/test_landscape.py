"""The landscape shows exact costs, and its views meet where the definitions say."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes

import perfcontrol as pc
from perfcontrol.plotting.landscape import Landscape, landscape
from perfcontrol.plotting.landscape_figure import _best_responses
from tests.oracles import performative_optima
from tests.solvers.test_long_run import belt
from tests.theory.problems import random_problem
from tests.tools import assert_close, assert_refused


def spread(seed: int = 3) -> pc.PerformativeProblem:
    """Two states, one input, two lags; volatility grows with the policy, mean free of it."""
    problem = random_problem(seed, bounded=False)
    return pc.PerformativeProblem(
        system=problem.system,
        horizon=5,
        memory=2,
        gain=problem.gain,
        noise=problem.noise,
        cost=problem.cost,
        perturbation=pc.DirectionalPerturbation([np.eye(2)], pc.Norm([0.1], [0.3], squared=True)),
        feasible_set=pc.FrobeniusBall(0.7),
    )


@pytest.fixture(scope="module")
def drawn() -> tuple[pc.PerformativeProblem, pc.PriceOfStability, Landscape]:
    problem = spread()
    price = pc.price_of_stability(problem, starts=4)
    return problem, price, landscape(problem, price)


Drawn = tuple[pc.PerformativeProblem, pc.PriceOfStability, Landscape]


def test_square_and_plane_hold_the_exact_costs_of_feasible_policies(drawn: Drawn) -> None:
    problem, price, found = drawn
    along = price.optimal - price.stable
    assert found.has_plane and found.plane_s is not None and found.plane_t is not None
    for i, j in ((25, 20), (20, 41), (33, 28)):
        world, M = (price.stable + found.s[k] * along for k in (i, j))
        assert_close(found.costs[i, j], pc.expected_cost(problem, M, deployed=world), 1e-12)
    shift, height = found.naive
    across = (price.naive - price.stable - shift * along) / height
    assert abs(np.sum(across * along)) < 1e-12 and np.linalg.norm(across) == pytest.approx(np.linalg.norm(along))
    outside = 0
    for k, j in ((3, 5), (20, 20), (30, 38), (40, 0)):
        M = price.stable + found.plane_s[j] * along + found.plane_t[k] * across
        if np.linalg.norm(M) > 0.7:
            assert np.isnan(found.own[k, j]) and np.isnan(found.frozen[k, j])
            outside += 1
        else:
            assert_close(found.own[k, j], pc.expected_cost(problem, M), 1e-12)
            assert_close(found.frozen[k, j], pc.expected_cost(problem, M, deployed=price.stable), 1e-12)
    assert np.isfinite(found.own).any()


def test_column_of_the_stable_world_is_lowest_on_the_diagonal_and_the_diagonal_at_the_optimum(drawn: Drawn) -> None:
    _, price, found = drawn
    (stable,), (optimal,) = np.flatnonzero(found.s == 0), np.flatnonzero(found.s == 1)
    assert_close(found.costs[stable, stable], price.cost_stable, 1e-12)
    assert_close(found.costs[optimal, optimal], price.cost_optimal, 1e-12)
    assert np.nanargmin(found.costs[stable]) == stable
    assert np.nanargmin(np.diagonal(found.costs)) == optimal
    assert np.nanargmin(found.costs[optimal]) != optimal, "in the world of the optimum a change seems to pay"
    assert np.nanmin(found.frozen) >= price.cost_stable * (1 - 1e-12) and np.nanmin(found.own) >= price.cost_optimal * (
        1 - 1e-12
    )
    response = _best_responses(found)
    assert response[stable] == pytest.approx(0, abs=1e-8)


def test_best_response_on_the_line_is_the_best_response_where_there_is_one_parameter() -> None:
    problem = performative_optima.location(10.0, 0.4, 0.5)[0]
    price = pc.price_of_stability(problem, starts=4)
    found = landscape(problem, price)
    assert not found.has_plane and found.plane_s is None
    response = _best_responses(found)
    along = price.optimal - price.stable
    for i in (10, 30, 50):  # beyond the ends of the line the curve stays at the end
        exact = float(((pc.best_response(problem, price.stable + found.s[i] * along) - price.stable) / along).item())
        assert response[i] == pytest.approx(np.clip(exact, found.s[0], found.s[-1]), abs=1e-9)
    assert_close(price.stable + found.naive[0] * along, price.naive, 1e-10)


def test_worlds_without_a_mean_square_limit_are_infinite() -> None:
    problem = belt()
    found = landscape(problem, pc.price_of_stability(problem, starts=4))
    assert np.isinf(found.costs).any() and np.isfinite(np.diagonal(found.costs)[found.s >= 0]).all()
    assert not np.isnan(found.costs).any()


def _marks(axes: Axes) -> set[tuple[float, float]]:
    """Where single points are drawn."""
    data = [np.asarray(line.get_xydata()) for line in axes.lines]
    return {(float(points[0, 0]), float(points[0, 1])) for points in data if len(points) == 1}


def test_figure_draws_three_views_or_two_and_marks_the_policies(drawn: Drawn, tmp_path: Path) -> None:
    problem, price, _ = drawn
    panels = pc.plotting.figure_landscape(problem, price)
    assert len(panels) == 3
    panels[0].figure.savefig(tmp_path / "three.png")
    line = performative_optima.location(10.0, 0.4, 0.5)[0]
    two = pc.plotting.figure_landscape(line)
    assert len(two) == 2
    two[0].figure.savefig(tmp_path / "two.png")
    assert all((tmp_path / f"{name}.png").stat().st_size > 20_000 for name in ("three", "two"))
    assert {(0.0, 0.0), (1.0, 1.0)} <= _marks(panels[1])
    assert {(0.0, price.cost_stable), (1.0, price.cost_optimal)} <= _marks(panels[2])
    plt.close("all")


def test_figure_uses_the_axes_given_and_leaves_the_first_empty_where_there_is_no_plane() -> None:
    figure, axes = plt.subplots(1, 3)
    panels = pc.plotting.figure_landscape(performative_optima.location(10.0, 0.4, 0.5)[0], axes=axes)
    assert list(panels) == list(axes[1:]) and not axes[0].axison
    assert not figure.legends and panels[-1].get_legend_handles_labels()[1]
    plt.close(figure)


def test_wrong_axes_and_problems_without_a_price_are_refused() -> None:
    quiet = random_problem(0, strength=0.0)
    assert_refused(lambda: pc.plotting.figure_landscape(quiet), "problem", "not the optimal one")
    assert_refused(lambda: pc.plotting.figure_landscape(quiet, axes=[plt.gca()]), "axes", "plt.subplots(1, 3)")
    assert_refused(lambda: pc.plotting.figure_landscape(None), "problem")
    plt.close("all")


@pytest.mark.parametrize("view", ["plane", "worlds", "line"])
def test_each_view_alone_is_that_of_the_figure(drawn: Drawn, view: str) -> None:
    problem, price, _ = drawn
    panel = pc.plotting.figure_landscape(problem, price)[("plane", "worlds", "line").index(view)]
    axes = pc.plotting.plot_landscape(problem, price, view=view, ax=plt.subplots()[1])
    assert axes.get_title() == panel.get_title() and _marks(axes) == _marks(panel)
    assert axes.get_xlim() == panel.get_xlim() and axes.get_ylim() == panel.get_ylim()
    plt.close("all")


def test_plane_of_policies_on_one_line_is_refused() -> None:
    problem = performative_optima.location(10.0, 0.4, 0.5)[0]
    assert_refused(lambda: pc.plotting.plot_landscape(problem, view="plane"), "view", "'line'")
    plt.close("all")
