"""What a user may declare of a problem where its parts do not know it; shared by the paper's and the rigorous kind."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from perfcontrol._checks import as_array, check_shape, fail
from perfcontrol.theory.stability.strong_stability import check_per_step

COST_CONSTANTS = ("strong_convexity", "smoothness", "gradient_bound")
SERIES = ("sensitivity", "perturbation_bound")
NUMBERS = ("noise_bound", "initial_bound", "policy_bound")


@dataclass(frozen=True, kw_only=True)
class Declarations:
    """Values that go before what the problem knows; None leaves it to the problem.

    estimate: sample the constants of a general cost that lacks them.
    """

    noise_bound: float | None = None
    initial_bound: float | None = None
    policy_bound: float | None = None
    perturbation_bound: Any = None
    sensitivity: Any = None
    strong_convexity: Any = None
    smoothness: Any = None
    gradient_bound: Any = None
    estimate: bool = False

    examples: ClassVar[dict[str, str]] = {
        "noise_bound": "noise_bound=2.0",
        "initial_bound": "initial_bound=5.0",
        "policy_bound": "policy_bound=1.0",
        "perturbation_bound": "perturbation_bound=0.5",
        "sensitivity": "sensitivity=0.1",
        "strong_convexity": "strong_convexity=0.5",
        "smoothness": "smoothness=2.0",
        "gradient_bound": "gradient_bound=2.0",
    }

    def __post_init__(self) -> None:
        for name in NUMBERS:
            if (value := self.declared(name)) is not None:
                check_shape(name, value, (), (), "Pass one number.")
                if value < 0:
                    raise fail(name, f"{value:.4g}", "be non-negative", "Pass zero or more: it bounds a norm.")
        for name in SERIES:
            if (value := self.declared(name)) is not None:
                check_per_step(name, value, None)
        for name in COST_CONSTANTS:
            if (value := self.declared(name)) is not None:
                if value.ndim > 1:
                    raise fail(
                        name,
                        f"shape {value.shape}",
                        "be a number or have shape (T+1,)",
                        "Pass one entry a stage, or one for all.",
                    )
                if np.any(value < 0):
                    raise fail(
                        name, f"{value.min():.4g}", "be non-negative", "Pass zero or more: the constants bound sizes."
                    )

    def declared(self, name: str) -> np.ndarray | None:
        """The declared value as an array, or None."""
        value = getattr(self, name)
        return None if value is None else np.asarray(as_array(name, value), dtype=float)
