"""How the tests run: precision, compilation, and which of them wait for `make check`."""

import os
from collections.abc import Iterator

import jax
import pytest

jax.config.update("jax_enable_x64", os.environ.get("PERFCONTROL_TEST_X64", "1") == "1")
# Tests compile much and run little: optimising what runs once costs more than it saves. `make check` optimises.
if os.environ.get("PERFCONTROL_TEST_OPTIMISED", "0") == "0":
    jax.config.update("jax_disable_most_optimizations", True)
    # The compiler's newer emitters take twice as long to compile as those that this flag chooses.
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"

# What takes longest and has a quicker sibling in the default run.
SLOW = (
    "test_constrained_response.py::test_best_response_matches_cvxpy_on_the_enumerated_quadratic[spectral ball and",
    "test_constrained_response.py::test_best_response_matches_cvxpy_on_the_enumerated_quadratic[rows in a box]",
    "test_constrained_response.py::test_best_response_matches_cvxpy_on_the_enumerated_quadratic[support and rows]",
    "test_reacting_noise.py::test_stable_point_is_its_own_best_response[free]",
    "test_reacting_noise.py::test_stable_point_is_its_own_best_response[ball]",
    "test_classical_limits.py::test_optimum_approaches_the_lqr_of_python_control_as_the_memory_grows",
    "test_intersection.py::test_best_response_on_an_intersection_equals_that_on_the_same_set_written_as_one",
    "test_intersection.py::test_intersection_without_newton_steps_still_converges",
    "test_intersection.py::test_intersection_projection_differentiates_in_the_parameters_of_its_sets",
    "test_bound.py::test_stocks_are_bounded_row_by_row[rows-True]",
    "test_market.py::test_allocations_are_feasible_and_are_what_they_are_called[rows]",
    "test_properties.py::test_single_precision_answers_like_double_precision",
    "test_stock.py::test_stable_policy_is_where_repeated_minimisation_goes_in_all_nine_cases[simplex]",
)


@pytest.fixture(autouse=True, scope="module")
def _programs_of_one_file_only() -> Iterator[None]:
    """Drop compiled programs after each file: thousands in one process exhaust its memory maps, and XLA crashes."""
    yield
    jax.clear_caches()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `SLOW` names."""
    for item in items:
        if any(name in item.nodeid for name in SLOW):
            item.add_marker(pytest.mark.slow)
