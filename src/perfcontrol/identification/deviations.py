"""How far each deployment is from a common fit: contributions of every episode, as functionals of its scores.

S_g = Σ_{u in g} s_u is the score of what deployment g alone would change. At the common fit it also carries the error
of that fit; to first order S_g = Σ_u a_ug with a_ug = 1[u in g] s_u - I_g I⁻¹ s_u, I = Σ_g I_g: of mean zero for every
unit if nothing reacts, whatever the policies.
"""

from typing import NamedTuple

import numpy as np

from perfcontrol.identification.moments import Sums


class Deviations(NamedTuple):
    """contributions (U, G, J); their sums over the units are what is tested."""

    contributions: np.ndarray

    def total(self) -> np.ndarray:
        """(G, J)."""
        return self.contributions.sum(axis=0)


def score_deviations(sums: Sums, group: np.ndarray, functional: np.ndarray) -> Deviations:
    """functionalᵀ S_g for functional (P, J)."""
    information = sums.information
    inverse = _pseudo_inverse(information.sum(axis=0))
    common = sums.score @ inverse  # (U, P)
    through = np.einsum("gpq,qj->gpj", information, functional)
    out = -np.einsum("up,gpj->ugj", common, through)
    out[np.arange(len(group)), group] += sums.score @ functional
    return Deviations(out)


def estimated_deviations(sums: Sums, group: np.ndarray, functional: np.ndarray) -> Deviations:
    """One scoring step for the coefficients of `functional` (P, J) in each deployment, all else being common."""
    information = sums.information
    inverse = _pseudo_inverse(information.sum(axis=0))
    deviations = score_deviations(sums, group, functional).contributions
    out = np.empty_like(deviations)
    for g, own in enumerate(information):
        effective = functional.T @ (own - own @ inverse @ own) @ functional
        out[:, g] = deviations[:, g] @ _pseudo_inverse(effective)
    return Deviations(out)


def _pseudo_inverse(matrix: np.ndarray) -> np.ndarray:
    """Of a positive semidefinite matrix, in columns of unit size."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return scale * np.linalg.pinv(matrix * scale * scale[:, None], rcond=1e-9, hermitian=True) * scale[:, None]
