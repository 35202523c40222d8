"""The disturbance-action law as a state-space controller of python-control.

With the noise given, the controller remembers it: s_t = [w_{t-1}; ...; w_{t-H}], u_t = -K x_t + Σ_i M[i-1] w_{t-i}.

Recovered from the state, its first block is the prediction p_t of x_t instead, so that w_{t-1} = x_t - p_t:

    u_t = -K x_t + M[0] (x_t - p_t) + Σ_{i≥2} M[i-1] w_{t-i},    p_{t+1} = A x_t + B u_t,    p_0 = x_0.
"""

from typing import Any, Literal

import numpy as np
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol._linalg import as_dense
from perfcontrol.problem import PerformativeProblem, check_problem


def to_control(
    problem: PerformativeProblem, M: Any, *, noise: Literal["given", "recovered"] = "given", dt: Any = True
) -> Any:
    """A policy as a `control.StateSpace` whose output is the input of the plant, u_t.

    With `noise="given"` its inputs are [x; w], and from the zero state it reproduces `pc.simulate` to rounding. With
    `noise="recovered"` they are x alone, and it recovers w_{t-1} = x_t - (A x_{t-1} + B u_{t-1}), A and B with the
    mean of the perturbations in the world that M makes: the same wherever the perturbations do not scatter, from the
    initial state [x_0; 0].

    Args:
        problem: with a gain, and for recovered noise matrices and means, that do not vary in time.
        M: free policy parameters, `problem.policy_shape`.
        noise: "given" as an input, or "recovered" from states and inputs.
        dt: sampling time; True for steps without a unit.

    Returns:
        Inputs and output carry the names of the system's states and inputs (`x[i]`, `u[j]` where it has none); noise is
        called by the name of its state with "w:" before it.

    Raises:
        InputError: a policy that does not fit; data that vary in time.
        ImportError: python-control is not installed.
    """
    try:
        import control
    except ImportError as error:
        raise ImportError("pc.interop.to_control needs python-control: pip install 'perfcontrol[interop]'.") from error
    lifted = check_problem(problem).lift(M)
    policy = np.asarray(lifted, dtype=float)
    if noise not in ("given", "recovered"):
        raise fail("noise", repr(noise), 'be "given" or "recovered"', "Pass one of these names.")
    memory, m, n = policy.shape
    if problem.has_gain and problem.gain.ndim == 3:
        raise fail(
            "problem",
            "a gain K_t that varies in time",
            "have a constant gain",
            "Build the problem with one gain (m, n): a StateSpace has none other.",
        )
    K = np.asarray(problem.gain, dtype=float)
    names = problem.system
    states = list(names.state_names or (f"x[{i}]" for i in range(n)))
    outputs = list(names.input_names or (f"u[{j}]" for j in range(m)))
    lags = np.hstack(list(policy))  # (m, H n)
    shift = np.kron(np.eye(memory, k=-1), np.eye(n))
    if noise == "given":
        first = np.eye(memory * n, n)  # where w_t comes in
        A, B = shift, np.hstack([np.zeros((memory * n, n)), first])
        C, D = lags, np.hstack([-K, np.zeros((m, n))])
        inputs = [*states, *(f"w:{name}" for name in states)]
    else:
        F, G = _mean_matrices(problem, lifted)
        C = np.hstack([-policy[0], lags[:, n:]])  # of [p; w_{t-2}; ...; w_{t-H}]
        D = policy[0] - K
        A, B = shift.copy(), np.zeros((memory * n, n))
        A[:n], B[:n] = G @ C, F + G @ D
        if memory > 1:  # w_{t-1} = x - p is remembered
            A[n : 2 * n, :n], B[n : 2 * n] = -np.eye(n), np.eye(n)
        inputs = states
    return control.ss(A, B, C, D, dt, inputs=inputs, outputs=outputs, name="policy")


def _mean_matrices(problem: PerformativeProblem, policy: Array) -> tuple[np.ndarray, np.ndarray]:
    """A and B with the mean of the perturbations, where none of them varies in time."""
    A, B = (np.asarray(as_dense(matrix), dtype=float) for matrix in (problem.system.A, problem.system.B))
    mean = problem.perturbation.mean(policy, problem.steps)
    if mean is None:
        got = "perturbations of unknown mean"
        raise fail("problem", got, "know E Δ_t to recover the noise", 'Pass noise="given".')
    mean = np.asarray(mean, dtype=float)
    if A.ndim == 3 or B.ndim == 3 or np.ptp(mean, axis=0).max(initial=0.0) > 0:
        raise fail("problem", "matrices that vary in time", "be the same at all times", 'Pass noise="given".')
    n = A.shape[0]
    return A + mean[0, :, :n], B + mean[0, :, n:] if mean.shape[-1] > n else B
