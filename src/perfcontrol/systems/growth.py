"""How fast a closed loop grows by itself, and a word about it where that is faster than it decays."""

import hashlib
import sys
import traceback
import warnings

import numpy as np

from perfcontrol._linalg import Matrix, as_dense
from perfcontrol._programs import known


class UnstableGainWarning(UserWarning):
    """The gain of a problem that is solved or certified leaves a closed loop A - BK that grows by itself.

    Legitimate over a finite horizon, so it is no error; said once for the same matrices. To silence it,
    `warnings.filterwarnings("ignore", category=pc.UnstableGainWarning)`.
    """


_looked_at: set[bytes] = set()


def growth(loop: np.ndarray) -> float:
    """The spectral radius of a closed loop (n, n); of one that varies, (T, n, n), that of its product to the 1/T."""
    if loop.ndim == 2:
        return float(np.max(np.abs(np.linalg.eigvals(loop)), initial=0.0))
    product, log_scale = np.eye(loop.shape[-1]), 0.0
    for step in loop:
        product = step @ product
        scale = np.linalg.norm(product)
        if not scale > 0:
            return 0.0
        product, log_scale = product / scale, log_scale + np.log(scale)
    radius = growth(product)
    return float(np.exp((np.log(radius) + log_scale) / len(loop))) if radius > 0 else 0.0


def _calls_from_outside() -> int:
    """The stack level, seen from the caller, of whoever called the package."""
    frames = (frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_stack(sys._getframe(1)))
    inside = [level for level, name in enumerate(frames, 1) if name.partition(".")[0] == "perfcontrol"]
    return inside[-1] + 1


def warn_of_growth(A: Matrix, B: Matrix, gain: Matrix) -> None:
    """Warn, once for the same matrices, where the closed loop under a gain (m, n) or (T, m, n) grows by itself.

    Silent under a trace, and where the numbers are not finite: those are told elsewhere.
    """
    if not known(A, B, gain):
        return
    rounding = 10 * float(np.sqrt(np.finfo(np.asarray(gain).dtype).eps))  # of a double eigenvalue, such as 1 here
    F, G, K = (np.asarray(as_dense(matrix), dtype=float) for matrix in (A, B, gain))
    loop = F - G @ K
    sizes = np.sqrt(np.abs(loop).sum(axis=-1).max(axis=-1) * np.abs(loop).sum(axis=-2).max(axis=-1))
    if np.all(sizes <= 1 + rounding) or not np.all(np.isfinite(loop)):  # no eigenvalue exceeds these
        return
    name = hashlib.blake2b(loop.tobytes(), digest_size=16).digest()
    if name in _looked_at:
        return
    _looked_at.add(name)
    radius = growth(loop)
    if radius > 1 + rounding:
        of = "spectral radius" if loop.ndim == 2 else "growth per step, ρ(product over time)^(1/T),"
        warnings.warn(
            f"The gain K leaves A - BK with a {of} of {radius:.6g} > 1: without perturbations the state grows so much "
            "each step. Over a finite horizon that is legitimate; if it is not meant, check the sign (u = -K x) or "
            "pass gain=pc.design_gain(system, Q=Q, R=R) (said once).",
            UnstableGainWarning,
            stacklevel=_calls_from_outside(),
        )
