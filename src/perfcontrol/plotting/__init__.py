"""Figures, as PNG and SVG: of the paper's experiment, and of the theory for a problem of one's own."""

from perfcontrol.plotting.theory_figures import figure_envelope, figure_error_bounds

__all__ = ["figure_envelope", "figure_error_bounds"]
