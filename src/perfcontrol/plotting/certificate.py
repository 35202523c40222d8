"""A certificate by contribution: which sensitivities use up what the condition allows."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from perfcontrol._checks import check_instance, fail
from perfcontrol.plotting.style import LOOKS, styled
from perfcontrol.plotting.subjects import panels
from perfcontrol.theory import Certificate

DECADES = 6  # shown below the largest contribution


def plot_certificate(certificate: Certificate, *, ax: Any = None) -> Axes:
    """What each sensitivity ε_t adds to the left side, their running sum, and the right side that it must stay below.

    Contributions more than six decades below the largest are not shown.

    Args:
        certificate: with contributions, as of `pc.certify(problem, "rigorous")` or "paper".
        ax: Matplotlib axes; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: a certificate without contributions.
    """
    certificate = check_instance("certificate", certificate, Certificate, "pc.certify(problem, 'rigorous')")
    shares = contributions_of(certificate)
    total, limit = float(shares.sum()), float(certificate.rhs or 0.0)
    look = LOOKS["optimal"]
    with styled():
        axes = panels(ax, 1, (4.2, 2.8))[0]
        t = np.arange(len(shares))
        axes.bar(t, shares, width=0.85, color=look.colour, alpha=0.55, label=r"contribution of $\varepsilon_t$")
        axes.step(t, np.cumsum(shares), where="mid", color=LOOKS["stable"].colour, label="sum so far")
        if limit > 0:
            axes.axhline(limit, color="#7F7F7F", linestyle=(0, (5, 2)), label="must stay below")
        top = max(total, limit)
        if top > 0:
            shown = shares[shares > 0]
            floor = max(shown.min() if shown.size else limit, (shown.max() if shown.size else limit) * 10.0**-DECADES)
            axes.set_yscale("log")
            low = min(floor, limit or floor) / 2
            axes.set_ylim(low, 3 * top * (3 * top / low) ** 0.35)  # room for the legend
        axes.set_xlim(-0.7, len(shares) - 0.3)
        axes.set_xlabel("time $t$")
        axes.set_ylabel("left side")
        axes.set_title(f"{certificate.kind}: {'holds' if certificate.holds else 'does not hold'}")
        axes.set_axisbelow(True)
        axes.legend(loc="upper left")
    return axes


def contributions_of(certificate: Certificate) -> np.ndarray:
    """(T,).

    Raises:
        InputError: there are none.
    """
    if certificate.contributions is None:
        kind = certificate.kind
        got = f"one of kind {kind!r}, not applicable here" if not certificate.applicable else f"one of kind {kind!r}"
        remedy = 'Pass pc.certify(problem, "rigorous"); where that is not applicable, its `missing` says what to add.'
        raise fail("certificate", got, "have contributions", remedy)
    return np.asarray(certificate.contributions, dtype=float)
