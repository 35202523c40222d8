"""`pc.report`: everything that the library can say about one problem, on one page."""

import datetime
import errno
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from perfcontrol._checks import check_instance, check_integer, fail
from perfcontrol._files import written_whole
from perfcontrol._printing import public_name
from perfcontrol.files import Run
from perfcontrol.problem import PerformativeProblem, check_problem
from perfcontrol.solvers import Solution


@dataclass(frozen=True)
class Report:
    """What `pc.report` returns; in a notebook it shows itself.

    Attributes:
        html: the page, which needs no other file and no network.
        missing: what the page does not show, by part, with the reason.
        seconds: that each part took.
    """

    html: str
    missing: dict[str, str]
    seconds: dict[str, float]

    def save(self, path: Any) -> Path:
        """Write the page, whole or not at all.

        Args:
            path: of the file, such as "report.html".
        """
        target = Path(path)
        with written_whole(target) as temporary:
            temporary.write_text(self.html, encoding="utf-8")
        return target

    def _repr_html_(self) -> str:
        style = "width:100%;height:40rem;border:1px solid #888"
        return f'<iframe title="Report" style="{style}" srcdoc="{escape(self.html)}"></iframe>'


def report(
    problem: Any,
    solution: Any = None,
    path: Any = None,
    *,
    title: str = "Performative control: a report",
    seed: int | None = None,
    samples: int = 1024,
    seconds: float | int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Report:
    """One page about a problem: what it is, whether a stable policy exists and how that is known, what naive, stable
    and optimal policy cost, how methods converge, what states, inputs and costs do, and what it all rests on.

    A solution does not hold its problem, so the problem comes first; a run that was kept holds both. What cannot be had
    (moments that are not known, no stable policy, an infinite horizon) is said in its section, with the reason.

    Args:
        problem: the problem; or a run, `pc.load(folder)`, whose solution and seed are then used.
        solution: of `pc.solve`, or several by name: their ends, policies and convergence are shown, too.
        path: of the file to write, such as "report.html"; None writes none.
        title: of the page.
        seed: root of all randomness; None for that of the run, or 0.
        samples: simulated paths of each policy.
        seconds: no new part is begun after so long; None for no limit. What was left out is named.
        progress: called with the name of a part, and 0 when it begins, 1 when it ends.

    Returns:
        A `Report`: `.html`, `.save(path)`, and what is missing.

    Raises:
        InputError: no problem; a solution of another problem, or a batch of them; fewer than 2 samples.
        OSError: the file cannot be written.
    """
    from perfcontrol.reports.page.document import document
    from perfcontrol.reports.page.findings import gather
    from perfcontrol.reports.page.sections import in_short, sections

    if isinstance(problem, Solution):
        raise fail(
            "problem",
            "a Solution",
            "be the problem",
            "Call pc.report(problem, solution): no solution holds its problem.",
        )
    every: dict[str, int] = {}
    if isinstance(problem, Run):
        seed = problem.seed if seed is None else seed
        name = "run" if problem.solver is None else public_name(problem.solver)
        every[name] = problem.every
        others = {} if solution is None else _runs(problem.problem, solution)
        problem, solution = problem.problem, {name: problem.solution} | others
    runs = _runs(check_problem(problem), solution)
    seed = check_integer("seed", 0 if seed is None else seed, 0)
    check_integer("samples", samples, 2)
    if seconds is not None and not seconds >= 0:
        raise fail("seconds", f"{seconds}", "be a time, or None", "Pass 600.0, or leave it out.")
    if path is not None:
        _check_target(Path(path))
    found = gather(problem, runs, every=every, seed=seed, samples=samples, seconds=seconds, progress=progress)
    byline = f"perfcontrol, {datetime.date.today().isoformat()}, seed {seed}"
    page = document(title, byline, in_short(found), sections(found))
    made = Report(page, dict(found.why_not), dict(found.seconds))
    if path is not None:
        made.save(path)
    return made


def _check_target(path: Path) -> None:
    """Raise OSError before the work, and not after it."""
    from perfcontrol.results import check_writable

    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a folder: name a file in it", str(path))
    check_writable(path.parent)


def _runs(problem: PerformativeProblem, solution: Any) -> dict[str, Solution]:
    if solution is None:
        return {}
    named = dict(solution) if isinstance(solution, Mapping) else {"run": solution}
    for run in named.values():
        check_instance("solution", run, Solution, "pc.solve(problem, pc.StablePoint())")
        problem.check_policy("solution", run.M)
    return {str(name): run for name, run in named.items()}
