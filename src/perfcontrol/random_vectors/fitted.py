"""A law that fits a problem: of its dimension, and of its horizon where it varies in time."""

import math
from typing import Any

from perfcontrol._checks import check_instance, fail, varies
from perfcontrol.random_vectors.base import AbstractRandomVector


def fitted_vector(name: str, law: Any, size: int, horizon: int | float) -> AbstractRandomVector:
    """`law` resized to dimension `size`; raises InputError where it cannot be, or covers another horizon."""
    example = "pc.Gaussian(mean, covariance)"
    if name == "noise":
        example += "`, or a policy map to one, such as `lambda M: pc.Gaussian(mean(M), covariance)"
    law = check_instance(name, law, AbstractRandomVector, example)
    law = law.resize(size)
    if law.size != size:
        raise fail(name, f"dimension {law.size}", f"have dimension n = {size}", "Pass one entry per state.")
    if math.isinf(horizon) and (law.mean.ndim == 2 or law.covariance.ndim == 3):
        raise varies(name, f"a law for {law.mean.shape[0]} time steps")
    if law.mean.ndim == 2 and law.mean.shape[0] != horizon:
        raise fail(
            name,
            f"{law.mean.shape[0]} time steps",
            f"cover the horizon of {horizon} steps",
            "Pass one row for each t = 0..horizon-1.",
        )
    return law
