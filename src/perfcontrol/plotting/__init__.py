"""Figures for a problem of one's own, each on Matplotlib axes of yours or new ones; and those of the theory.

Matplotlib is loaded when the first of them is asked for.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from perfcontrol._calls import explain_call

if TYPE_CHECKING:  # editors, type checkers and the reference read the list
    from perfcontrol.plotting.certificate import plot_certificate
    from perfcontrol.plotting.convergence import plot_convergence
    from perfcontrol.plotting.costs import plot_costs
    from perfcontrol.plotting.landscape_figure import figure_landscape, plot_landscape
    from perfcontrol.plotting.policy import plot_policy
    from perfcontrol.plotting.theory_figures import figure_envelope, figure_error_bounds
    from perfcontrol.plotting.trajectories import plot_trajectories

_FILES = {
    "figure_envelope": "theory_figures",
    "figure_error_bounds": "theory_figures",
    "figure_landscape": "landscape_figure",
    "plot_certificate": "certificate",
    "plot_convergence": "convergence",
    "plot_costs": "costs",
    "plot_landscape": "landscape_figure",
    "plot_policy": "policy",
    "plot_trajectories": "trajectories",
}

__all__ = [
    "figure_envelope",
    "figure_error_bounds",
    "figure_landscape",
    "plot_certificate",
    "plot_convergence",
    "plot_costs",
    "plot_landscape",
    "plot_policy",
    "plot_trajectories",
]


def __getattr__(name: str) -> Any:
    """A figure, or a module of this room, when first asked for."""
    if name in _FILES:
        function = explain_call(__name__, name, getattr(import_module(f"{__name__}.{_FILES[name]}"), name))
        return globals().setdefault(name, function)
    if not name.startswith("_") and find_spec(f"{__name__}.{name}"):
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)
