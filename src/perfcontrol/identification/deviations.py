"""How far each deployment is from a common fit: contributions of every episode, as functionals of its scores.

S_g = Σ_{u in g} s_u is the score of what deployment g alone would change. At the common fit it also carries the error
of that fit; to first order S_g = Σ_u a_ug with a_ug = 1[u in g] s_u - I_g I⁻¹ s_u, I = Σ_g I_g: of mean zero for every
unit if nothing reacts, whatever the policies.
"""

import numpy as np

from perfcontrol.identification.blocks import pseudo_inverse
from perfcontrol.identification.moments import Sums


def score_deviations(sums: Sums, group: np.ndarray, functional: np.ndarray) -> np.ndarray:
    """Contributions (U, G, J) to functionalᵀ S_g, for functional (P, J)."""
    information = sums.information
    common = sums.score @ pseudo_inverse(information.sum(axis=0))
    out = -np.einsum("up,gpj->ugj", common, information @ functional, optimize=True)
    out[np.arange(len(group)), group] += sums.score @ functional
    return out


def estimated_deviations(sums: Sums, group: np.ndarray, functional: np.ndarray) -> np.ndarray:
    """Contributions (U, G, J) to one scoring step along the columns of `functional` in deployment g alone."""
    inverse = pseudo_inverse(sums.information.sum(axis=0))
    out = score_deviations(sums, group, functional)
    for g, own in enumerate(sums.information):
        through = own @ functional
        out[:, g] = out[:, g] @ pseudo_inverse(functional.T @ through - through.T @ inverse @ through)
    return out


def centred(contributions: np.ndarray, group: np.ndarray) -> np.ndarray:
    """About the mean of each deployment, for the degree of freedom that it takes; flattened to (U, G J)."""
    flat = contributions.reshape(len(contributions), -1)
    out = np.empty_like(flat)
    for h in np.unique(group):
        rows = group == h
        count = int(rows.sum())
        out[rows] = (flat[rows] - flat[rows].mean(axis=0)) * np.sqrt(count / max(count - 1, 1))
    return out
