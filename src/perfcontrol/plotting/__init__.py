"""Figures: of the paper's experiment, of the theory for a problem of one's own, of its landscape."""

from perfcontrol.plotting.landscape_figure import figure_landscape
from perfcontrol.plotting.theory_figures import figure_envelope, figure_error_bounds

__all__ = ["figure_envelope", "figure_error_bounds", "figure_landscape"]
