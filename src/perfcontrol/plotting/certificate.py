"""A certificate by contribution: which sensitivities use up what the condition allows."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from perfcontrol._checks import check_instance, fail
from perfcontrol.plotting.style import LOOKS, styled
from perfcontrol.plotting.subjects import panels
from perfcontrol.theory import Certificate, Sharp

BARS = 200


def plot_certificate(certificate: Certificate, *, ax: Any = None) -> Axes:
    """What each sensitivity ε_t adds to the left side of a certificate; of the sharp one what each reaction Δ_t adds.

    The title says both sides, and whether the certificate holds.

    Args:
        certificate: with contributions, as of `pc.certify(problem, "rigorous")`, "paper" or `pc.Sharp(by_time=True)`.
        ax: Matplotlib axes; None makes a figure.

    Returns:
        The axes.

    Raises:
        InputError: a certificate without contributions.
    """
    certificate = check_instance("certificate", certificate, Certificate, "pc.certify(problem, 'rigorous')")
    shares = contributions_of(certificate)
    total, limit = float(certificate.lhs or 0.0), float(certificate.rhs or 0.0)
    with styled():
        axes = panels(ax, 1, (4.2, 2.8))[0]
        t = np.arange(len(shares))
        label = r"contribution of $\Delta_t$" if certificate.kind == Sharp.name else r"contribution of $\varepsilon_t$"
        colour = LOOKS["optimal"].colour
        if len(t) <= BARS:
            axes.bar(t, shares, width=0.85, color=colour, alpha=0.6)
        else:  # one outline in place of thousands of bars
            axes.stairs(shares, np.append(t, len(t)) - 0.5, fill=True, color=colour, alpha=0.6)
        axes.set_axisbelow(True)
        axes.set_xlim(-0.7, len(shares) - 0.3)
        axes.set_xlabel("time $t$")
        axes.set_ylabel(label)
        sign, verdict = ("<", "holds") if certificate.holds else (r"\geq", "does not hold")
        axes.set_title(f"{certificate.kind}: {total:.3g} ${sign}$ {limit:.3g}, {verdict}")
    return axes


def contributions_of(certificate: Certificate) -> np.ndarray:
    """(T,).

    Raises:
        InputError: there are none.
    """
    if certificate.contributions is None:
        kind = certificate.kind
        got = f"one of kind {kind!r}, not applicable here" if not certificate.applicable else f"one of kind {kind!r}"
        remedy = 'Pass pc.certify(problem, pc.Sharp(by_time=True)), or "rigorous"; `missing` says what to add.'
        raise fail("certificate", got, "have contributions", remedy)
    return np.asarray(certificate.contributions, dtype=float)
