"""Theory in single precision: the answers are those of double precision for the numbers that the problem holds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol import theory
from perfcontrol.theory import certificate_row, contraction_estimate, existence, hessian, mean_square_stability
from perfcontrol.theory.certificates.certify import KINDS
from perfcontrol.theory.precision import double_precision
from perfcontrol.theory.stability.sampled_jacobian import sample_jacobians
from tests.theory.problems import prediction_problem, random_problem
from tests.tools import assert_refused

pytestmark = pytest.mark.float32


def cast(problem, dtype):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), dtype), problem)


def single_and_double(problem):
    """The same numbers, rounded to single precision, held in single and in double precision."""
    single = cast(problem, jnp.float32)
    with double_precision():
        return single, cast(single, jnp.float64)


@pytest.mark.parametrize("sensitivity", [0.9, 0.9999999, 1.0000001, -1.4])
def test_rate_of_single_precision_numbers_is_known_to_double_precision(sensitivity):
    """Single precision would round ε - 1 = ±1e-7 away, and with it on which side of one the rate lies."""
    single, _ = single_and_double(prediction_problem(sensitivity))
    certificate = pc.certify(single, "sharp", samples=0, pairs=0)
    slope = float(np.float32(sensitivity))
    assert certificate.rate == pytest.approx(abs(slope), abs=1e-12)
    assert certificate.holds is (abs(slope) < 1)
    assert hessian(single, np.zeros((1, 1, 1), np.float32)) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_certificates_say_the_same_in_both_precisions(kind):
    single, double = single_and_double(random_problem(3, strength=1e-3))
    settings = {"samples": 16, "pairs": 2} if kind == "sharp" else {}
    with double_precision():
        expected = certificate_row(pc.certify(double, kind, **settings))
    assert certificate_row(pc.certify(single, kind, **settings)) == expected


def test_single_precision_is_left_as_it_was_found():
    single, _ = single_and_double(random_problem(0, "scalar"))
    before = jax.config.jax_enable_x64
    existence(single)
    assert jax.config.jax_enable_x64 is before and single.dtype == jnp.float32
    assert pc.best_response(single, jnp.zeros((1, 1, 1), jnp.float32)).dtype == jnp.float32


def test_estimates_and_steps_agree_in_both_precisions():
    single, double = single_and_double(random_problem(3, strength=1e-6))
    key = jax.random.key(0)

    def answers(problem):
        stability = mean_square_stability(problem, samples=16)
        sensitivity = pc.estimate_sensitivity(problem, key=key, policies=2, samples=4)
        small = pc.strong_stability(problem.system, problem.gain)
        return [
            contraction_estimate(problem, pairs=2),
            stability.threshold_estimate,
            stability.error_floor(stability.threshold_estimate / 4),
            pc.safe_step(problem),
            sensitivity.epsilon,
            *pc.theorem_step_size(problem),
            pc.rrm_error_bound(problem, 1.0, 2),
            pc.rsgd_error_bound(problem, 1e-4, 1.0, 2),
            theory.sum_threshold(problem).threshold,
            theory.sensitivity_envelope(problem).envelope,
            small.kappa,
            small.gamma,
        ]

    with double_precision():
        expected = answers(double)
    for found, value in zip(answers(single), expected, strict=True):
        np.testing.assert_allclose(found, value, rtol=1e-7)


def test_probes_after_the_call_are_in_double_precision():
    single, double = single_and_double(random_problem(3, strength=1e-3))
    M, key = np.zeros(single.policy_shape), jax.random.key(0)
    basis = np.eye(M.size)
    with double_precision():
        expected = sample_jacobians(double, M, basis, key, 8, held=False).halves[0].mean_square(basis)
        halves = sample_jacobians(double, M, basis, key, 8, held=False).halves
    np.testing.assert_allclose(halves[0].mean_square(basis), expected, rtol=1e-13)


def test_closed_form_takes_the_largest_step_as_single_precision_holds_it():
    single, _ = single_and_double(random_problem(0, "scalar", strength=1e-5))
    phi1, phi2 = pc.theorem_step_size(single)
    rounded = np.nextafter(np.float32(phi1 / phi2), np.float32(np.inf))
    assert rounded > phi1 / phi2
    bound = pc.rsgd_error_bound(single, jnp.asarray(rounded), 1.0, 5, form="closed")
    assert np.all(np.isfinite(bound))
    above = jnp.asarray(1.00001 * rounded, jnp.float32)
    assert_refused(lambda: pc.rsgd_error_bound(single, above, 1.0, 5, form="closed"), "step_size", "theorem_step_size")
