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
    "test_properties.py::test_single_precision_answers_like_double_precision",
    "test_stock.py::test_stable_policy_is_where_repeated_minimisation_goes_in_all_nine_cases[simplex]",
    # What these show is shown by quicker tests as well, for another family or in a smaller case.
    "test_intersection.py::TestSpectralBallBoxAndRowSum",
    "test_intersection.py::TestRowSumAndBox",
    "test_intersection.py::test_intersection_projection_satisfies_its_variational_inequality_far_outside[30.0]",
    "test_intersection.py::test_two_unbounded_sets_that_make_a_simplex_project_and_support_like_it",
    "test_sharp.py::test_strong_performativity_makes_the_local_test_only_local",
    "test_sharp.py::test_unconstrained_response_jacobian_is_minus_inverse_hessian_times_reaction",
    "test_sharp.py::test_contraction_estimate_is_a_lower_estimate_of_the_proved_modulus",
    "test_certificates.py::test_contraction_bounds_are_never_exceeded_and_order_as_proved",
    "test_stability_rates_orders.py::test_error_bounds_lie_above_measured_runs",
    "test_stability_rates_orders.py::test_small_early_sensitivities_are_preferred_by_the_bound_and_not_always",
    "test_stable_point.py::TestStablePoint::test_solutions_of_stacked_problems_and_keys_equal_single_runs",
    "test_stable_point.py::test_stable_point_never_minimises_again_after_newton_when_minimisation_expands",
    "test_continuation.py::TestContinuation::test_solutions_of_stacked_problems_and_keys_equal_single_runs",
    "test_continuation.py::TestContinuation::test_history_keeps_the_record_of_every_other_step",
    "test_continuation.py::test_continuation_finds_what_repeated_minimisation_cycles_about",
    "test_best_response.py::test_constrained_best_response_matches_cvxpy_and_its_variational_inequality",
    "test_rrm.py::TestRRM::test_solutions_of_stacked_problems_and_keys_equal_single_runs",
    "test_reacting_noise.py::test_stable_point_is_its_own_best_response[rows]",
    "test_two_gradients.py::test_descent_along_the_wrong_gradient_ends_elsewhere",
    "test_properties.py::test_compiled_cost_equals_the_one_run_operation_by_operation",
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
