"""What logs leave open, in words."""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.estimate import Estimated
from perfcontrol.identification.features import Features
from perfcontrol.identification.location import Location
from perfcontrol.identification.moments import images_of
from perfcontrol.identification.transitions import Transitions

SHARE = 1e-3  # of the largest part of what cannot be told, below which a part does not belong to it


class Gap(NamedTuple):
    """text: what is not known, and what would tell. blocks: whether A or B is part of it."""

    text: str
    blocks: bool


def untold(data: Transitions, location: Location) -> list[Gap]:
    """What of A and B the states and inputs of these logs cannot tell."""
    n, m = data.x.shape[1], data.v.shape[1]
    found = []
    for direction in _directions(location.unidentified[n : n + m]):
        text = f"B along the input direction {_shown(direction)}: u + K x never moves there, so that only A - B K is"
        found.append(Gap(text + " known (deploy a policy that acts there)", True))
    for direction in _directions(location.unidentified[:n]):
        text = f"A along the state direction {_shown(direction)}: the state does not move there"
        found.append(Gap(text + " by itself (start episodes elsewhere)", True))
    return found


def gaps(data: Transitions, estimated: Estimated, mean: Features, scale: Features) -> list[Gap]:
    """Everything that these logs cannot tell, the gravest first."""
    found = untold(data, estimated.location)
    if estimated.spread.tangent.shape[-1]:
        text = "the law of the perturbations beyond their second moments: other directions may give the same ones"
        found.append(Gap(text + " (expected costs do not tell them apart)", False))
    found += split_variances(data, estimated)
    policies = data.policies.reshape(len(data.policies), -1)
    if len(policies) == 1:
        found.append(Gap("any reaction: only one policy was deployed (deploy a second)", False))
        return found
    for what, features in (("mean dynamics", mean), ("perturbation scales", scale)):
        values = features.values(data.policies)
        short = values.shape[1] - np.linalg.matrix_rank(values, tol=1e-9 * np.abs(values).max())
        if short:
            text = f"how the {what} follow the policy: {len(policies)} policies do not tell {values.shape[1]}"
            found.append(Gap(f"{text} coefficients of '{features.name}' apart", False))
    tried = int(np.linalg.matrix_rank(policies - policies[0], tol=1e-9 * max(np.abs(policies).max(), 1e-300)))
    if tried < policies.shape[1] and "affine" in (mean.name, scale.name):
        text = f"slopes of the reaction in {policies.shape[1] - tried} of {policies.shape[1]} directions of the policy"
        found.append(Gap(text + ": never tried, taken as zero", False))
    return found


def split_variances(data: Transitions, estimated: Estimated) -> list[Gap]:
    """Noise and given directions whose squares look alike on the states of these logs."""
    spread, n = estimated.spread, data.y.shape[1]
    s = n * (n + 1) // 2
    found = []
    for vector in estimated.hidden.T:
        moved = np.abs(vector[s:]).reshape(spread.scales.shape).max(axis=1, initial=0.0)
        parts = [f"direction {k + 1}" for k in np.flatnonzero(moved > SHARE * np.abs(vector).max())]
        with_noise = np.abs(vector[:s]).max(initial=0.0) > SHARE * np.abs(vector).max()
        if with_noise:
            parts = ["the noise", *parts]
        if len(parts) > 1:
            text = f"how variance is split between {', '.join(parts[:-1])} and {parts[-1]}: their squares look alike"
            found.append(Gap(text + " on these states (move the states otherwise, or leave one out)", False))
        elif not with_noise and not np.any(images_of(data, spread.directions)[:, np.argmax(moved)]):
            found.append(Gap(f"the scale along {parts[0]}: the states never moved what it acts on", False))
    return found


def _directions(rows: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what the columns of `rows` span, one vector a row."""
    if rows.size == 0:
        return np.zeros((0, len(rows)))
    vectors, sizes, _ = np.linalg.svd(rows, full_matrices=False)
    return vectors[:, sizes > 1e-9 * max(1.0, sizes.max())].T


def _shown(direction: np.ndarray) -> str:
    leading = direction[np.argmax(np.abs(direction))]
    return "[" + ", ".join(f"{x:.2g}" for x in np.round(direction / np.sign(leading), 9) + 0.0) + "]"
