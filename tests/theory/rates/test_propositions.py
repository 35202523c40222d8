"""Propositions 1 and 2 against the certificate."""

import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory import sensitivity_envelope, sum_threshold
from tests.theory.problems import random_problem

pytestmark = pytest.mark.float32


def test_propositions_agree_with_the_certificate():
    problem = random_problem(5, "wide", strength=1e-6)
    certificate = pc.certify(problem, "rigorous")
    threshold, envelope = sum_threshold(problem), sensitivity_envelope(problem)
    assert threshold.threshold == pytest.approx(certificate.rhs / certificate.weights.max())
    assert not threshold.holds or certificate.holds
    np.testing.assert_allclose(envelope.envelope, certificate.rhs / certificate.weights)
    assert not certificate.holds or envelope.holds


def test_printed_propositions_ask_for_their_regime():
    stable = random_problem(5, "scalar", strength=1e-6, growth=0.3)
    with pytest.raises(pc.InputError, match="ζ"):
        sensitivity_envelope(stable, printed=True)
    assert sum_threshold(stable, printed=True).threshold > 0
