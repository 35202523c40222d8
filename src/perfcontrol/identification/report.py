"""A fit in words and as a labelled table."""

from typing import Any

import numpy as np

from perfcontrol.identification.files import labels
from perfcontrol.identification.parameter import Parameter

VALUES = ("estimate", "standard_error", "low", "high")


def interval(estimate: Parameter) -> np.ndarray:
    """Estimate, standard error and the ends of the 95 % interval, stacked in front."""
    return np.stack([np.asarray(estimate.mean), np.asarray(estimate.standard_error), *estimate.interval()])


def table(fit: Any) -> Any:
    """See `Fit.table`."""
    import xarray

    acted = "from_state" if fit.mean_reaction.mean.shape[2] == fit.logs.state_size else "from_both"
    dimensions = {
        "A": ("state", "from_state"),
        "B": ("state", "input"),
        "noise_mean": ("state",),
        "noise_covariance": ("state", "from_state"),
        "mean_reaction": ("mean_feature", "state", acted),
        "scale": ("direction", "scale_coefficient"),
        "deployed_scale": ("deployment", "direction"),
        "directions": ("direction", "state", acted),
    }
    named = labels(fit.logs)
    states, inputs = named.get("state"), named.get("input")
    if states is not None:
        named["from_state"] = states
    if states is not None and inputs is not None and acted == "from_both":
        named["from_both"] = [*states, *inputs]
    variables = {name: (("value", *dims), interval(getattr(fit, name))) for name, dims in dimensions.items()}
    return xarray.Dataset(
        variables,
        coords={"value": list(VALUES), **named},
        attrs={
            "mean_features": fit.mean_features.name,
            "scale_features": fit.scale_features.name,
            "episodes": len(fit.logs),
            "transitions": fit.logs.transitions,
            "unidentified": "; ".join(fit.unidentified),
        },
    )


def paragraph(fit: Any) -> str:
    """See `Fit.__str__`."""
    episodes, policies = len(fit.logs), len(fit.logs.policies)
    n, m = fit.logs.state_size, fit.logs.input_size
    said = [
        f"Fitted to {fit.logs.transitions} transitions of {episodes} episodes under {policies} "
        f"polic{'y' if policies == 1 else 'ies'}: {n} states, {m} inputs."
    ]
    said.append(_accuracy("A", fit.A) + " " + _accuracy("B", fit.B))
    spread = np.sqrt(np.diag(np.asarray(fit.noise_covariance.mean)))
    said.append(f"The noise has standard deviations {_numbers(spread)}.")
    if fit.scale.mean.size:
        scales = interval(fit.deployed_scale)
        parts = [
            f"{abs(low):.3g} to {abs(high):.3g}" if abs(high) - abs(low) > 1e-12 else f"{abs(low):.3g}"
            for low, high in (sorted((column.min(), column.max()), key=abs) for column in scales[0].T)
        ]
        how = (
            "does not depend on the policy"
            if fit.scale_features.name == "constant"
            else (f"follows the policy by '{fit.scale_features.name}'")
        )
        said.append(
            f"The scale of the perturbations along {len(parts)} direction{'s' * (len(parts) > 1)} {how}: "
            f"{'; '.join(parts)} over the deployed policies."
        )
    if fit.mean_features.name == "constant":
        said.append("The mean dynamics are taken not to react.")
    else:
        size = np.linalg.norm(np.asarray(fit.mean_reaction.mean), axis=(1, 2))
        said.append(f"The mean dynamics react by '{fit.mean_features.name}', slopes of norm {_numbers(size)}.")
    open_questions = fit.unidentified
    said.append("Not identified: " + "; ".join(open_questions) + "." if open_questions else "Nothing is left open.")
    return " ".join(said)


def _accuracy(name: str, estimate: Parameter) -> str:
    error = np.asarray(estimate.standard_error)
    if not np.all(np.isfinite(error)):
        return f"{name} is known in part."
    size = float(np.linalg.norm(np.asarray(estimate.mean)))
    return f"{name} (norm {size:.3g}) is known to a standard error of {np.linalg.norm(error):.2g}."


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
