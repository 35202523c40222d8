"""The local test against performative prediction and a problem with several stable policies."""

import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from tests.theory.problems import prediction_problem


@pytest.mark.parametrize("sensitivity", [0.0, 0.5, 0.9, 0.999, 1.001, 1.7, -0.5, -1.4])
def test_performative_prediction_has_rate_exactly_its_sensitivity(sensitivity):
    certificate = pc.certify(prediction_problem(sensitivity), "sharp", samples=0, pairs=0)
    assert certificate.rate == pytest.approx(abs(sensitivity), abs=1e-12)
    assert certificate.holds is (abs(sensitivity) < 1)
    assert certificate.exists is True
    np.testing.assert_allclose(certificate.values["M"], 10 / (1 - sensitivity), rtol=1e-9)
    # θ - η(1-ε)(θ - θ*): stable for ε < 1 and η < 2/(1-ε), also for ε < -1 where repeated minimisation diverges
    assert certificate.values["mean_field_stable"] is (sensitivity < 1)
    if sensitivity < 1:
        assert certificate.values["mean_step"] == pytest.approx(2 / (1 - sensitivity))


def test_performative_prediction_has_no_stable_point_at_sensitivity_one():
    certificate = pc.certify(prediction_problem(1.0), "sharp", samples=0, pairs=0)
    assert certificate.exists is False and certificate.holds is False
    assert certificate.rate == pytest.approx(1.0)
    assert "No stable policy exists" in str(certificate)


def test_above_sensitivity_one_a_stable_point_exists_and_repeated_minimisation_diverges():
    problem = prediction_problem(1.3)
    certificate = pc.certify(problem, "sharp", samples=0)
    assert certificate.exists is True and certificate.holds is False
    solution = pc.solve(problem, pc.RRM(), certificate.values["M"] + 1e-3, throw=False, max_steps=50)
    assert abs(float(solution.M.squeeze()) - float(certificate.values["M"].squeeze())) > 100


def test_strong_performativity_makes_the_local_test_only_local():
    """Φ(M) = 3 tanh(2(M - 2)) + M/10 contracts at each outer fixed point, and stretches sixfold between them."""
    one = np.ones((1, 1))
    problem = pc.PerformativeProblem(
        system=pc.LinearSystem(0 * one, -one),
        horizon=2,
        noise=pc.Constant([1.0]),
        cost=pc.QuadraticCost(np.array([0.0, 0.0, 0.5]).reshape(3, 1, 1), 0 * one),
        perturbation=pc.DirectionalPerturbation(
            [one], np.array([0.1]), mean=lambda M: jnp.stack([0 * M[0], -1 + 3 * jnp.tanh(2 * (M[0] - 2)) + 0.1 * M[0]])
        ),
    )
    certificate = pc.certify(problem, "sharp", samples=0, pairs=64)
    assert certificate.holds is True
    assert certificate.values["contraction_estimate"] > 1.5
    far = [pc.solve(problem, pc.RRM(), np.full((1, 1, 1), start)).M.item() for start in (-1.0, 4.0)]
    assert abs(far[0] - far[1]) > 1  # another stable policy attracts from elsewhere
