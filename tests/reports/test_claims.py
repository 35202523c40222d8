"""Intervals and verdicts of claims, against independent numbers."""

import numpy as np
import pytest
from scipy import stats

from perfcontrol.reports.claims import Claim, as_markdown, bootstrap, loglog_slope, wilson


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (3, 10), (32, 32)])
def test_wilson_matches_scipy(successes: int, trials: int) -> None:
    share, interval = wilson(successes, trials)
    expected = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    assert share == successes / trials
    np.testing.assert_allclose(interval, (expected.low, expected.high), atol=1e-12)


def test_bootstrap_interval_covers_the_mean_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(1)
    hits = 0
    for trial in range(200):
        _, (low, high) = bootstrap(generator.normal(size=60), np.mean, count=200, seed=trial)
        hits += low <= 0 <= high
    assert 0.88 <= hits / 200 <= 0.99


def test_loglog_slope_recovers_a_power_law() -> None:
    steps = np.arange(10, 1000)
    assert loglog_slope(steps, 3.0 * steps**-1.25) == pytest.approx(-1.25, abs=1e-12)


def test_markdown_lists_every_claim_with_its_verdict() -> None:
    claim = Claim("c", "s", "t", 0.5, (0.4, 0.6), "r", "does not hold", "d")
    text = as_markdown([claim, claim._replace(claim="other", verdict="holds")], {"seeds": 2})
    assert text.count("**does not hold**") == 2
    assert "| 2 | other |" in text
    assert "seeds = 2" in text
    assert claim.as_dict()["interval"] == [0.4, 0.6]
