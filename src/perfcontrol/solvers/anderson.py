"""Anderson acceleration of M ← Φ(M): from the last few policies and their images, where the gap Φ(M) - M vanishes.

With f_n = Φ(M_n) - M_n and differences Δf_i = f_{i+1} - f_i, ΔΦ_i = Φ(M_{i+1}) - Φ(M_i) of the last m steps,
    γ = argmin ‖f_n - Σ_i γ_i Δf_i‖,    M_{n+1} = Φ(M_n) - Σ_i γ_i ΔΦ_i.
Where Φ is affine this is GMRES on (I - Φ') M = Φ(0), which ends after as many steps as Φ' has distinct eigenvalues,
whatever their size.
"""

from typing import Any

import equinox as eqx

from perfcontrol._linalg import solve
from perfcontrol._programs import Numbers, numerics

RIDGE = 64  # roundings, beside unit columns: directions told apart by less than its root are left alone


class Mixing(eqx.Module):
    """What is remembered; rows that are not filled yet are zero.

    gap, image: of the last step, (p,). gaps, images: differences of successive ones, (m, p).
    """

    gap: Numbers
    image: Numbers
    gaps: Numbers
    images: Numbers


def forget(M: Any, count: int) -> Mixing:
    """Nothing remembered yet, of so many differences."""
    xp, _ = numerics(M)
    none, rows = xp.zeros(M.size, M.dtype), xp.zeros((count, M.size), M.dtype)
    return Mixing(none, none, rows, rows)


def mix(mixing: Mixing, step: Any, M: Any, image: Any) -> tuple[Any, Mixing]:
    """The policy that follows M with image Φ(M), and what is remembered from then on; `step` counts from 0."""
    xp, _ = numerics(mixing, step, M, image)
    gap, flat = (image - M).reshape(-1), image.reshape(-1)
    filled = xp.asarray(step > 0, gap.dtype)  # the first step has no predecessor
    gaps = xp.concatenate([filled * (gap - mixing.gap)[None], mixing.gaps[:-1]])
    images = xp.concatenate([filled * (flat - mixing.image)[None], mixing.images[:-1]])
    length = xp.sqrt(xp.sum(gaps**2, axis=1))
    length = xp.where(length > 0, length, 1)
    unit = gaps / length[:, None]
    normal = unit @ unit.T + RIDGE * xp.finfo(gap.dtype).eps * xp.eye(len(unit), dtype=gap.dtype)
    weights = solve(normal, unit @ gap)
    weights = weights + solve(normal, unit @ (gap - weights @ unit))  # takes back most of what the ridge has changed
    return (flat - weights / length @ images).reshape(M.shape), Mixing(gap, flat, gaps, images)
