"""How problems and solutions read when printed: a title and a few rows, as text and as HTML for notebooks."""

import html
import math
from typing import Any

import numpy as np

Row = tuple[str, str]


class Printed:
    """Prints as what `described` says: a title and rows."""

    def described(self) -> tuple[str, list[Row]]:
        """The title and the rows."""
        raise NotImplementedError

    def __str__(self) -> str:
        title, rows = self.described()
        width = max(len(name) for name, _ in rows)
        return "\n".join([title, *(f"  {name:<{width}}  {value}" for name, value in rows)])

    def _repr_html_(self) -> str:
        title, rows = self.described()
        left = ' style="text-align:left"'
        cells = "".join(
            f"<tr><th{left}>{html.escape(name)}</th><td{left}>{html.escape(value)}</td></tr>" for name, value in rows
        )
        return f"<table><caption>{html.escape(title)}</caption>{cells}</table>"


def number(value: Any) -> str:
    """A number with four figures, whole numbers and truth values as they are; of several the range."""
    numbers = np.asarray(value)
    if numbers.dtype == bool:
        return f"{int(numbers.sum())} of {numbers.size} yes" if numbers.ndim else "yes" if numbers else "no"
    if numbers.ndim:
        ends = f"{number(numbers.min())} to {number(numbers.max())}, " if numbers.size else ""
        return f"{ends}shape {numbers.shape}"
    return str(int(numbers)) if np.issubdtype(numbers.dtype, np.integer) else f"{float(numbers):.4g}"


def count(number: int, noun: str) -> str:
    """A number of things."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def public_name(part: Any) -> str:
    """The name of the first class of an object that a user may know: not one that begins with an underscore."""
    return next(kind.__name__ for kind in type(part).__mro__ if not kind.__name__.startswith("_"))


def of_problem(problem: Any) -> tuple[str, list[Row]]:
    """What a problem is made of, in the order of its arguments."""
    shape, system = problem.policy_shape, problem.system
    timed = "" if np.ndim(system.A) < 3 else ", varying in time"
    noise = public_name(problem.noise) + (" (reacts to the deployed policy)" if problem.noise_reacts else "")
    policy = f"memory {problem.memory}, {count(math.prod(shape), 'free parameter')} of shape {tuple(shape)}"
    return "Performative control problem", [
        ("system", f"{count(problem.state_size, 'state')}, {count(problem.input_size, 'input')}{timed}"),
        ("horizon", "infinite: average cost per stage" if not problem.is_finite else str(problem.horizon)),
        ("noise", noise),
        ("cost", public_name(problem.cost)),
        ("policy", policy),
        ("gain", "given" if problem.has_gain else "none"),
        ("perturbation", public_name(problem.perturbation)),
        ("feasible set", public_name(problem.feasible_set)),
        ("initial state", public_name(problem.initial_state)),
        ("structure", public_name(problem.structure)),
    ]


def of_solution(solution: Any, ended: str) -> tuple[str, list[Row]]:
    """How a run ended, after how many steps, what it found and how accurately."""
    M = np.asarray(solution.M)
    rows = [("result", ended), ("steps", number(solution.steps))]
    rows.append(("policy", f"shape {M.shape}, Frobenius norm {number(np.linalg.norm(M.reshape(-1)))}"))
    return "Solution", rows + [(name.replace("_", " "), number(value)) for name, value in solution.stats.items()]
