"""Discrete-time plants of python-control and SciPy as linear systems."""

from typing import Any

import numpy as np

from perfcontrol._checks import fail
from perfcontrol.systems import LinearSystem

DISCRETE = "Discretise it first: control.c2d(sys, dt), or sys.to_discrete(dt) of SciPy."


def from_control(sys: Any) -> LinearSystem:
    """A discrete-time system of python-control or SciPy as a linear system, with its signal names.

    x_{t+1} = A x_t + B u_t alone is taken over: policies see the state, so C and D play no part. Transfer functions are
    realised by the package that they come from.

    Args:
        sys: `control.StateSpace` or `control.TransferFunction` with a sampling time; `scipy.signal.dlti` in any form.

    Returns:
        A linear system; `state_names` and `input_names` are those of python-control, None from SciPy.

    Raises:
        InputError: continuous time, no sampling time, no state, or something else than a system.
    """
    from scipy.signal import dlti, lti

    if isinstance(sys, lti):
        raise fail("sys", "a system in continuous time", "be in discrete time", DISCRETE)
    if isinstance(sys, dlti):
        realised: Any = sys.to_ss()  # type: ignore[attr-defined]
        return _system(realised.A, realised.B, None, None)
    kind = type(sys)
    if kind.__module__.partition(".")[0] == "control" and kind.__name__ in ("StateSpace", "TransferFunction"):
        import control

        if sys.dt is None or sys.dt == 0:
            got = "a system in continuous time" if sys.dt == 0 else "a system without sampling time"
            raise fail(
                "sys", got, "be in discrete time", f"{DISCRETE} Or pass dt=True to control.ss: steps without a unit."
            )
        plant: Any = sys if kind.__name__ == "StateSpace" else control.ss(sys)
        return _system(plant.A, plant.B, plant.state_labels, plant.input_labels)
    required = "be a control.StateSpace, a control.TransferFunction or a scipy.signal.dlti"
    raise fail("sys", "None" if sys is None else kind.__name__, required, "Use pc.LinearSystem(A, B) for matrices.")


def _system(A: Any, B: Any, states: Any, inputs: Any) -> LinearSystem:
    if np.size(A) == 0:
        raise fail(
            "sys",
            "a gain without state",
            "have at least one state",
            "Pass a plant with states: a static gain needs no control over time.",
        )
    return LinearSystem(A, B, state_names=states, input_names=inputs)
