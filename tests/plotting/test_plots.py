"""Figures of one's own problem draw the numbers that the library returns."""

import math
import subprocess
import sys

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_hex

import perfcontrol as pc
from perfcontrol.plotting.style import LOOKS
from tests.evaluate.cases import replaced
from tests.solvers.problems import performative_prediction, steered
from tests.theory.problems import random_problem
from tests.tools import assert_close, assert_refused

KEY = jax.random.key(3)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


def named() -> pc.PerformativeProblem:
    problem = steered()
    system = pc.LinearSystem(problem.system.A, problem.system.B, ["price $", "stock"], ["order"])
    return replaced(problem, system=system)


def lines(axes, colour):
    return [np.asarray(line.get_ydata()) for line in axes.lines if to_hex(line.get_color()) == colour.lower()]


def test_trajectories_are_quantiles_of_simulated_paths_of_each_policy_in_its_own_world():
    problem = named()
    policies = {"stable": 0.2 * np.ones(problem.policy_shape), "mine": np.zeros(problem.policy_shape)}
    drawn = pc.plotting.plot_trajectories(problem, policies, key=KEY, samples=32, band=0.8)
    assert [axes.get_title() for axes in drawn] == [r"price \$", "stock", "order"]
    paths = pc.simulate(problem, policies["stable"], key=KEY, samples=32)
    for axes, values in zip(drawn, [paths.x[..., 0], paths.x[..., 1], paths.u[..., 0]], strict=True):
        low, middle, high = np.quantile(np.asarray(values), [0.1, 0.5, 0.9], axis=0)
        for curve, expected in zip(lines(axes, LOOKS["stable"].colour), (middle, low, high), strict=True):
            assert_close(curve, expected, 1e-12, 1e-5)
    assert [text.get_text() for text in drawn[0].figure.legends[0].get_texts()] == ["stable", "mine"]
    drawn[0].figure.canvas.draw()


def test_paths_in_another_world_may_be_given_and_one_signal_drawn_on_axes_of_ones_own():
    problem = named()
    M = 0.2 * np.ones(problem.policy_shape)
    paths = pc.simulate(problem, M, deployed=-M, key=KEY, samples=16)
    own = plt.subplots()[1]
    (axes,) = pc.plotting.plot_trajectories(problem, {"naive": paths}, signals="order", ax=own)
    assert axes is own
    assert_close(lines(axes, LOOKS["naive"].colour)[0], np.median(np.asarray(paths.u)[..., 0], axis=0), 1e-12, 1e-5)


def test_of_many_signals_those_that_vary_most_are_shown():
    problem = random_problem(1, "wide")  # 3 states and 2 inputs: all; stretched to more: six
    assert len(pc.plotting.plot_trajectories(problem, problem.initial_policy(), key=KEY, samples=4)) == 5
    n, loud = 9, [1, 2, 5, 8]
    scale = np.full(n, 0.1)
    scale[loud] = 2.0
    many = pc.PerformativeProblem(
        system=pc.LinearSystem(0.5 * np.eye(n), np.eye(n)[:, :1]),
        horizon=4,
        noise=pc.Rademacher(scale),
        cost=pc.QuadraticCost(np.eye(n), np.eye(1)),
    )
    drawn = pc.plotting.plot_trajectories(many, many.initial_policy(), key=KEY, samples=4)
    titles = [axes.get_title() for axes in drawn]
    assert len(titles) == 6 and {f"x[{i}]" for i in loud} <= set(titles)


def test_infinite_horizons_are_cut_off():
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5]], [[1.0]]),
        horizon=math.inf,
        noise=pc.Rademacher([1.0]),
        cost=pc.QuadraticCost([[1.0]], [[1.0]]),
    )
    (axes, _) = pc.plotting.plot_trajectories(problem, [[[0.1]]], key=KEY, samples=4)
    assert len(axes.lines[0].get_xdata()) == 101
    assert pc.plotting.plot_costs(problem, [[[0.1]]], key=KEY, samples=8).get_xlabel().endswith("per stage")


def test_heat_map_holds_the_lifted_policy_lag_by_lag():
    problem = pc.experiments.stock_market()
    M = np.arange(100.0).reshape(1, 10, 10)
    axes = pc.plotting.plot_policy(problem, M)
    lifted = np.asarray(problem.lift(M))
    assert_close(axes.collections[0].get_array().reshape(20, 20), lifted[0], 1e-12, 1e-6)
    problem = random_problem(0)  # two lags, one input, two states
    M = np.array([[[1.0, -2.0]], [[3.0, -4.0]]])
    axes = pc.plotting.plot_policy(problem, M)
    assert [text.get_text() for text in axes.texts] == ["1", "-2", "3", "-4"]
    low, high = axes.collections[0].get_clim()
    assert low == -high == -4
    assert [label.get_text() for label in axes.child_axes[0].get_xticklabels()] == ["lag 1", "lag 2"]
    axes.figure.canvas.draw()


def test_heat_map_of_the_zero_policy_is_drawn():
    problem = random_problem(0, "scalar")
    pc.plotting.plot_policy(problem, problem.initial_policy()).figure.canvas.draw()


def test_convergence_draws_distances_of_iterates_and_a_cross_where_a_run_failed():
    problem = performative_prediction(0.5)
    exact = pc.solve(problem, pc.StablePoint()).M
    good = pc.solve(problem, pc.RRM(1e-4))
    bad = pc.solve(performative_prediction(-3.0), pc.RRM(), throw=False)
    assert bad.result != pc.Result.success
    axes = pc.plotting.plot_convergence({"good": good, "bad": bad}, exact)
    steps = int(good.steps)
    distances = np.abs(np.asarray(good.history) - np.asarray(exact)).reshape(-1)[: steps + 1]
    assert_close(axes.lines[0].get_ydata(), distances, 1e-12, 1e-5)
    assert axes.lines[1].get_label() == "bad" and axes.lines[2].get_marker() == "x"
    assert axes.lines[2].get_xdata()[0] <= int(bad.steps)
    axes.figure.canvas.draw()


def test_convergence_of_a_batch_is_its_median_and_every_scales_the_steps():
    problem = performative_prediction(0.5)
    solver = pc.RSGD(steps=20, step_size=0.05)
    runs = jax.vmap(lambda key: pc.solve(problem, solver, key=key, every=5))(jax.random.split(KEY, 6))
    exact = pc.solve(problem, pc.StablePoint()).M
    axes = pc.plotting.plot_convergence(runs, exact, every=5)
    errors = np.abs(np.asarray(runs.history) - np.asarray(exact)).reshape(6, -1)
    assert_close(axes.lines[0].get_ydata(), np.median(errors, axis=0), 1e-12, 1e-5)
    assert list(axes.lines[0].get_xdata()) == [0, 5, 10, 15, 20]


def test_costs_are_distributed_as_simulated_and_their_means_marked():
    problem = named()
    M = 0.2 * np.ones(problem.policy_shape)
    axes = pc.plotting.plot_costs(problem, {"optimal": M, "naive": 0 * M}, key=KEY, samples=400)
    costs = np.asarray(pc.simulate(problem, M, key=KEY, samples=400).cost)
    assert axes.lines[0].get_xdata()[0] == pytest.approx(costs.mean(), rel=1e-6)
    values, edges, _ = axes.patches[0].get_data()
    inside = (costs >= edges[0]) & (costs <= edges[-1])
    assert values.sum() == pytest.approx(100 * inside.mean(), abs=1e-6) and inside.mean() >= 0.985


def test_certain_costs_are_drawn_too():
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem([[0.5]], [[1.0]]),
        horizon=3,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost([[1.0]], [[1.0]]),
    )
    pc.plotting.plot_costs(problem, [[[0.0]]], key=KEY, samples=4).figure.canvas.draw()


@pytest.mark.parametrize("limit", [0.5, 2.0], ids=["does not hold", "holds"])
def test_certificate_draws_its_contributions_and_says_both_sides(limit):
    shares = np.array([-0.1, 0.4, 0.7])
    certificate = pc.Certificate("rigorous", "", True, holds=limit > 1, lhs=1.0, rhs=limit, contributions=shares)
    axes = pc.plotting.plot_certificate(certificate)
    assert_close([bar.get_height() for bar in axes.containers[0]], shares)
    assert axes.get_title() in (r"rigorous: 1 $\geq$ 0.5, does not hold", "rigorous: 1 $<$ 2, holds")
    axes.figure.canvas.draw()


def test_contributions_add_up_to_the_left_side():
    certificate = pc.certify(random_problem(0, strength=1e-5), "rigorous")
    bars = [bar.get_height() for bar in pc.plotting.plot_certificate(certificate).containers[0]]
    assert sum(bars) == pytest.approx(certificate.lhs)


def test_what_does_not_fit_is_refused():
    problem = named()
    M = problem.initial_policy()
    plot = pc.plotting
    assert_refused(lambda: plot.plot_trajectories(problem, M), "key")
    assert_refused(lambda: plot.plot_trajectories(problem, {}, key=KEY), "policies")
    assert_refused(lambda: plot.plot_trajectories(problem, M[0], key=KEY), "policies")
    assert_refused(lambda: plot.plot_trajectories(problem, M, key=KEY, signals=["speed"]), "signals", "stock, order")
    assert_refused(lambda: plot.plot_trajectories(problem, M, key=KEY, band=1.0), "band")
    assert_refused(lambda: plot.plot_trajectories(problem, M, key=KEY, ax=plt.gca()), "ax", "subplots(1, 3)")
    assert_refused(lambda: plot.plot_costs(problem, M, key=KEY, samples=1), "samples")
    assert_refused(lambda: plot.plot_costs(problem, M, key=KEY, ax="here"), "ax")
    assert_refused(lambda: plot.plot_policy(problem, M[0]), "M")
    assert_refused(lambda: plot.plot_convergence({}), "solutions")
    assert_refused(lambda: plot.plot_convergence({"M": M}), "solutions")
    recorded = pc.solve(problem, pc.StablePoint(), record=lambda M: M.sum())
    assert_refused(lambda: plot.plot_convergence(recorded), "solutions", "record")
    failed = pc.solve(performative_prediction(-3.0), pc.RRM(), throw=False)
    assert_refused(lambda: plot.plot_convergence(failed), "reference")
    assert_refused(lambda: plot.plot_certificate(pc.certify(problem, "sharp")), "certificate", "rigorous")
    assert_refused(lambda: plot.plot_certificate(pc.certify(problem, "rigorous")), "certificate", "not applicable")
    assert_refused(lambda: plot.plot_landscape(problem, view="cube"), "view", "worlds")
    assert_refused(lambda: plot.plot_policy(problem, M, axes=plt.gca()), "axes", "ax")


def test_matplotlib_waits_until_a_figure_is_asked_for():
    program = "import sys, perfcontrol as pc; pc.plotting, pc.solve; before = 'matplotlib' in sys.modules; "
    program += "pc.plotting.plot_costs; print(before, 'matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
