"""Figures of the theory are drawn from what the theory returns."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from perfcontrol.plotting import figure_envelope, figure_error_bounds
from perfcontrol.theory import SensitivityEnvelope, envelope_shape


def test_envelope_figure_is_written_where_some_limits_are_infinite(tmp_path: Path) -> None:
    envelope = 1e-3 * envelope_shape(1.1, 20)
    envelope[-1] = np.inf
    before = plt.get_fignums()
    files = figure_envelope(SensitivityEnvelope(np.full(20, 1e-4), envelope, False, 1.1), tmp_path / "envelope")
    assert [path.suffix for path in files] == [".png", ".svg"]
    assert all(path.stat().st_size > 1000 for path in files)
    assert plt.get_fignums() == before


def test_error_bound_figure_is_written(tmp_path: Path) -> None:
    n = np.arange(50)
    errors = np.random.default_rng(0).uniform(0.5, 1.5, (8, 50)) / (n + 1)
    files = figure_error_bounds(errors, {"corrected": 2 / (n + 1), "printed": 3 / (n + 1)}, tmp_path / "bounds")
    assert all(path.stat().st_size > 1000 for path in files)
