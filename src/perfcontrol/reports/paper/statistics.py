"""What several claims count: orders, the worst of them, how far the runs came."""

from typing import Any

import numpy as np
import xarray

SECTION = "Numerical Experiments"


def worst(values: dict[str, tuple[float, tuple[float, float]]]) -> tuple[str, float, tuple[float, float]]:
    """The order with the largest statistic: a claim about all orders stands or falls with it."""
    name = max(values, key=lambda order: values[order][0])
    return name, *values[name]


def listed(values: dict[str, Any]) -> str:
    """ "ascending 0.1, descending 0.2, ..."."""
    return ", ".join(
        f"{order} {value[0] if isinstance(value, tuple) else value:.3g}" for order, value in values.items()
    )


def relative_error(runs: xarray.Dataset, regime: str, order: str) -> np.ndarray:
    """Final over initial squared error of each seed."""
    error = runs["error"].sel(regime=regime, order=order).values
    return error[:, -1] / error[:, 0]


def orders(dataset: xarray.Dataset) -> list[str]:
    """The orders of the sensitivities in a dataset."""
    return [str(order) for order in dataset["order"].values]
