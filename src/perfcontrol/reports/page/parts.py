"""What a problem is, in words and numbers: one row for each of its parts."""

import math
from typing import Any

import numpy as np

from perfcontrol._linalg import Matrix, as_dense
from perfcontrol._printing import count, public_name
from perfcontrol.problem import PerformativeProblem
from perfcontrol.reports.page.markup import Html, bullets, joined, number, paragraph, table
from perfcontrol.theory.facts import facts


def what_it_is(problem: PerformativeProblem) -> Html:
    """The model in a sentence, the parts in a table."""
    n, m = count(problem.state_size, "state"), count(problem.input_size, "input")
    span = f"over {problem.horizon} steps" if problem.is_finite else "in the long run, per stage"
    size = math.prod(problem.policy_shape)
    lags = count(problem.memory, "past disturbance")
    body = paragraph(
        f"A linear system with {n} and {m} is controlled {span}. The policy has {count(size, 'free number')} and "
        f"answers {lags}. The system reacts to the policy that is deployed: the law of its perturbations",
        "and that of its noise depend on it." if problem.noise_reacts else "depends on it.",
    )
    body = Html(body + bullets(_equations(problem)))
    return Html(body + table("The parts of the problem", ["Part", "What it is", "Numbers"], _rows(problem)))


def _equations(problem: PerformativeProblem) -> list[Html]:
    z = (
        "[x_t; u_t]"
        if problem.perturbation.columns(problem.state_size, problem.input_size) > problem.state_size
        else "x_t"
    )
    H = problem.memory
    further = "" if H == 1 else f"{' +' if H == 2 else ' + ... +'} M[{H - 1}] w_{{t-{H}}}"
    gain = "−K x_t + " if problem.has_gain else ""
    cost = "the sum of c_t(x_t, u_t) over t = 0..T" if problem.is_finite else "the average of c(x_t, u_t)"
    return [
        joined([f"x_{{t+1}} = A x_t + B u_t + Δ_t {z} + w_t, with Δ_t from the law that the deployed policy makes"]),
        joined([f"u_t = {gain}M[0] w_{{t-1}}{further}"]),
        joined([f"the cost C_T(M; M') is the expectation of {cost}, for the policy M in the world that M' makes"]),
    ]


def _rows(problem: PerformativeProblem) -> list[list[object]]:
    known = facts(problem)
    system = problem.system
    timed = ", varying in time" if system.horizon is not None else ""
    names = ""
    if system.state_names or system.input_names:
        names = "; ".join(", ".join(group) for group in (system.state_names, system.input_names) if group)
    gain = "u = −K x added" if problem.has_gain else "none"
    laws = "reacts to the deployed policy; numbers of the policy nearest to zero" if problem.noise_reacts else ""
    size = f"A {problem.state_size} × {problem.state_size}, B {problem.state_size} × {problem.input_size}"
    loop = _radius(problem.closed_loop(system.A, system.B))
    noise = _moments(known.noise_mean, known.noise_covariance, known.noise_bound)
    start = _bounded("norm at most ", known.initial_bound) if problem.is_finite else "plays no part"
    policy = f"memory {problem.memory}, structure {public_name(problem.structure)}"
    return [
        ["system", f"{size}{timed}. {names}", joined(["spectral radius of A: ", number(_radius(system.A), 4)])],
        ["gain K", gain, joined(["spectral radius of A − B K: ", number(loop, 4)])],
        ["noise w", f"{public_name(problem.noise)}. {laws}", noise],
        ["initial state", public_name(problem.initial_state), start],
        ["perturbation Δ", _family(problem), _reaction(known.perturbation_bound, known.sensitivity)],
        ["stage cost c", public_name(problem.cost), _discount(problem)],
        ["feasible set", public_name(problem.feasible_set), _bounded("‖M‖_F at most ", known.radius)],
        ["policy M", policy, f"shape {problem.policy_shape}"],
    ]


def _radius(matrix: Matrix) -> float:
    """The spectral radius, the largest over time."""
    return float(np.abs(np.linalg.eigvals(np.asarray(as_dense(matrix), dtype=float))).max())


def _moments(mean: np.ndarray, covariance: np.ndarray, bound: Any) -> Html:
    spread = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    average = "mean zero" if not np.any(mean) else f"means {_range(mean)}"
    return joined([f"{average}, standard deviations {_range(spread)}; ", _bounded("norm at most ", bound)])


def _range(values: np.ndarray) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def _bounded(words: str, bound: Any) -> Html:
    return joined(["unbounded, or no bound is known"] if bound is None else [words, number(bound, 4)])


def _family(problem: PerformativeProblem) -> str:
    law = problem.perturbation
    directions = getattr(law, "directions", None)
    several = "" if directions is None else f", {count(len(directions), 'direction')}"
    n, m = problem.state_size, problem.input_size
    acts = "on state and input" if law.columns(n, m) > n else "on the state"
    return f"{public_name(law)}{several}; acts {acts}"


def _reaction(bound: np.ndarray | None, sensitivity: np.ndarray | None) -> Html:
    size = "size not known to be bounded" if bound is None else f"‖Δ_t‖ at most {_range(bound)}"
    speed = (
        "sensitivity not known" if sensitivity is None else f"sensitivity at most {_range(sensitivity)} a unit of ‖M‖_F"
    )
    return joined([f"{size}; {speed}"])


def _discount(problem: PerformativeProblem) -> str:
    discount = getattr(problem.cost, "discount", None)
    return "all stages count alike" if discount is None else f"stage t counts {float(discount):.4g}^t"
