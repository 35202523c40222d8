"""The split of the local rate over time, against the rate of problems whose reaction is scaled at one time alone."""

import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory.stability.local_model import local_model, spectral_radius
from perfcontrol.theory.stability.rate_by_time import rate_by_time
from tests.evaluate.cases import replaced
from tests.solvers.problems import steered
from tests.theory.problems import random_problem
from tests.tools import assert_close


def scaled(problem, M, factors):
    """The law stays the same at M, where the reaction of each time is multiplied by its factor, (T,)."""
    lifted = np.asarray(problem.lift(M))

    def about(policy_map, inner):
        if policy_map is None:
            return None
        offset, slope = np.asarray(policy_map.offset), np.asarray(policy_map.slope)
        if offset.ndim == inner:  # the same at all times
            offset, slope = (np.repeat(part[None], problem.horizon, axis=0) for part in (offset, slope))
        stretched = np.reshape(factors, (-1, *(1,) * (slope.ndim - 1))) * slope
        return pc.Affine(offset + np.tensordot(slope - stretched, lifted, 3), stretched)

    law = problem.perturbation
    reaction = pc.DirectionalPerturbation(law.directions, about(law.scale, 1), mean=about(law.mean_map, 2))
    return replaced(problem, perturbation=reaction)


def rate_when(problem, M, time, factor):
    factors = np.ones(problem.horizon)
    factors[time] = factor
    return spectral_radius(local_model(scaled(problem, M, factors), M).response_jacobian)


@pytest.mark.parametrize(
    "problem",
    [
        random_problem(0, strength=0.5, bounded=False),
        random_problem(3, strength=0.5),
        pytest.param(random_problem(1, "wide", strength=0.3, bounded=False), marks=pytest.mark.slow),
        steered(),
    ],
    ids=["free", "ball", "two directions", "mean and scale"],
)
def test_terms_are_derivatives_of_the_rate_by_the_reaction_at_each_time(problem):
    M = pc.solve(problem, pc.StablePoint()).M
    model = local_model(problem, M)
    terms = rate_by_time(problem, model)
    assert_close(terms.sum(), spectral_radius(model.response_jacobian), 1e-9, 1e-4)
    for time in range(problem.horizon):
        h = 1e-4
        slope = (rate_when(problem, M, time, 1 + h) - rate_when(problem, M, time, 1 - h)) / (2 * h)
        assert abs(slope - terms[time]) <= 1e-5 * np.abs(terms).max()
    assert np.abs(terms).max() > 1e-6


def test_certificate_splits_its_rate_when_asked():
    problem = random_problem(0, strength=0.5, bounded=False)
    plain = pc.certify(problem, "sharp", samples=0, pairs=0)
    split = pc.certify(problem, pc.Sharp(samples=0, pairs=0, by_time=True))
    assert plain.contributions is None
    assert split.contributions.sum() == pytest.approx(split.lhs) and split.lhs == pytest.approx(plain.lhs)
    assert "adds most to the rate" in str(split)
    assert pc.plotting.plot_certificate(split).get_title().startswith("sharp")


@pytest.mark.slow
def test_reaction_of_the_market_is_split_too():
    problem = pc.experiments.stock_market("descending")
    certificate = pc.certify(problem, pc.Sharp(samples=0, pairs=0, by_time=True))
    assert certificate.contributions.shape == (60,)
    assert certificate.contributions.sum() == pytest.approx(certificate.lhs, rel=1e-5)
