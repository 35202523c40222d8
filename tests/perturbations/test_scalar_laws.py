"""The scalar laws against SciPy's."""

import numpy as np
import pytest
from scipy import integrate, stats

from perfcontrol.perturbations.scalar_laws import CUTOFF, SCALAR_LAWS


def test_truncated_gaussian_has_the_bound_and_mean_absolute_value_of_scipys():
    law = stats.truncnorm(-CUTOFF, CUTOFF)
    mean_absolute = 2 * integrate.quad(lambda z: z * law.pdf(z), 0, CUTOFF)[0]
    ours = SCALAR_LAWS["truncated_gaussian"]
    assert ours.bound == pytest.approx(CUTOFF / law.std(), rel=1e-12)
    assert ours.mean_absolute == pytest.approx(mean_absolute / law.std(), rel=1e-10)


def test_uniform_has_the_bound_and_mean_absolute_value_of_scipys():
    law = stats.uniform(-np.sqrt(3), 2 * np.sqrt(3))
    ours = SCALAR_LAWS["uniform"]
    assert law.std() == pytest.approx(1.0) and ours.bound == pytest.approx(law.support()[1])
    assert ours.mean_absolute == pytest.approx(law.expect(abs), rel=1e-8)
