"""Figures of the theory: a problem's sensitivities against Proposition 2, and error bounds over measured runs."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import ArrayLike

from perfcontrol.plotting.style import save_figure, styled
from perfcontrol.theory import SensitivityEnvelope

_BOUND_COLOURS = ("#C0392B", "#E69F00", "#009E73", "#56B4E9")


def figure_envelope(result: SensitivityEnvelope, path: Path) -> list[Path]:
    """The ε_t of a problem and what each must stay below for the condition to be satisfiable (Proposition 2).

    Args:
        result: of `perfcontrol.theory.sensitivity_envelope`.
        path: without suffix; PNG and SVG are written.
    """
    with styled():
        figure, axes = plt.subplots(figsize=(4.2, 2.8), layout="constrained")
        t = np.arange(len(result.epsilon))
        finite = np.isfinite(result.envelope)
        axes.semilogy(t[finite], result.envelope[finite], color="#C0392B", label="envelope (Proposition 2)")
        axes.semilogy(t, np.where(result.epsilon > 0, result.epsilon, np.nan), "o", ms=3, label=r"$\varepsilon_t$")
        axes.set_xlabel("time $t$")
        axes.set_ylabel("sensitivity")
        axes.set_title("all below the envelope" if result.holds else "some above the envelope")
        axes.legend()
        return save_figure(figure, path)


def figure_error_bounds(errors: ArrayLike, bounds: Mapping[str, ArrayLike], path: Path) -> list[Path]:
    """Measured squared errors, their mean, and bounds of the mean.

    Args:
        errors: (seed, N+1) squared distances to the stable policy.
        bounds: curves (N+1,) by name, such as those of `pc.rsgd_error_bound`.
        path: without suffix; PNG and SVG are written.
    """
    measured = np.asarray(errors, dtype=float)
    with styled():
        figure, axes = plt.subplots(figsize=(4.2, 2.8), layout="constrained")
        n = np.arange(measured.shape[1]) + 1
        low, high = np.percentile(measured, [10, 90], axis=0)
        axes.fill_between(n, low, high, color="#0072B2", alpha=0.18, linewidth=0)
        axes.plot(n, measured.mean(axis=0), color="#0072B2", label="mean of measured runs")
        for colour, (name, curve) in zip(_BOUND_COLOURS, bounds.items(), strict=False):
            axes.plot(n, np.asarray(curve), color=colour, linestyle="--", label=name)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("iteration $n + 1$")
        axes.set_ylabel(r"$\|M_n - M^{\mathrm{PS}}\|_F^2$")
        axes.legend()
        return save_figure(figure, path)
