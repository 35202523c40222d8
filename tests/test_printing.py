"""Printed problems and solutions say in words what they are."""

import jax
import jax.numpy as jnp

import perfcontrol as pc


def small(**changes):
    parts = {
        "system": pc.LinearSystem([[0.8]], [[1.0]]), "horizon": 4, "noise": pc.Uniform([-1.0], [1.0]),
        "cost": pc.QuadraticCost([[1.0]], [[0.1]]),
        "perturbation": pc.DirectionalPerturbation([[[1.0]]], pc.Norm([0.1], [0.2])),
    }  # fmt: skip
    return pc.PerformativeProblem(**parts | changes)


def test_a_problem_names_its_parts_in_the_order_of_its_arguments():
    text = str(small())
    names = [line.split("  ")[1] for line in text.splitlines()[1:]]
    assert names[:4] == ["system", "horizon", "noise", "cost"]
    for word in (
        "1 state, 1 input",
        "Uniform",
        "QuadraticCost",
        "DirectionalPerturbation",
        "Unconstrained",
        "memory 1",
    ):
        assert word in text
    assert "infinite" in str(small(horizon=float("inf")))
    assert "reacts to the deployed policy" in str(small(noise=lambda M: pc.Gaussian(jnp.zeros(1), 1 + M[0] ** 2)))


def test_no_private_class_name_is_printed():
    class _Mine(pc.QuadraticCost):
        pass

    text = str(small(cost=_Mine([[1.0]], [[0.1]])))
    assert "_Mine" not in text and "QuadraticCost" in text


def test_a_solution_says_how_it_ended_after_how_many_steps_and_how_accurately():
    solution = pc.solve(small(), pc.StablePoint())
    text = str(solution)
    assert text == solution.summary() and "The run ended as asked." in text
    steps = next(line for line in text.splitlines() if line.strip().startswith("steps"))
    assert steps.split()[-1] == str(int(solution.steps))
    assert f"{float(solution.stats['residual']):.4g}" in text and "unique" in text
    assert "f64[" not in text and "i64[" not in text


def test_a_batch_says_how_many_runs_ended_in_which_way():
    solver = pc.RSGD(steps=3, step_size=jnp.asarray(0.01))
    keys = jax.random.split(jax.random.key(0), 4)
    text = str(jax.vmap(lambda key: pc.solve(small(), solver, key=key))(keys))
    assert "4 of 4: The run ended as asked." in text and "shape (4, 1, 1, 1)" in text


def test_notebooks_get_a_table_with_everything_escaped():
    table = small()._repr_html_()
    assert table.startswith("<table>") and table.count("<tr>") == 10
    assert "&lt;" not in table and "<script" not in table
    assert pc.solve(small(), pc.StablePoint())._repr_html_().count("<tr>") >= 5


def test_inside_a_trace_solutions_print_their_structure():
    seen = []

    def run(M0):
        solution = pc.solve(small(), pc.StablePoint(), M0)
        seen.append(str(solution))
        return solution.M

    jax.jit(run)(jnp.zeros((1, 1, 1)))
    assert "Solution(" in seen[0]
