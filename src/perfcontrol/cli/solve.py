"""`perfcontrol solve`."""

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from perfcontrol.cli.app import app, configure_jax, console, in_words
from perfcontrol.cli.plans import AsJson, File, Seed, Settings, cost_of, kept, plan_in, solved
from perfcontrol.cli.progress import stages

if TYPE_CHECKING:
    from perfcontrol.files.run import Run

KINDS = ("paper", "rigorous", "global", "sharp")
STATUSES = ("proved", "declared", "estimated")  # from the strongest on


@app.command()
def solve(
    file: File = Path("problem.toml"),
    out: Annotated[Path | None, typer.Option(help="Keep the run in this new folder.")] = None,
    seed: Seed = None,
    settings: Settings = None,
    certify: Annotated[bool, typer.Option(help="Also say whether a stable policy exists.")] = True,
    as_json: AsJson = False,
) -> None:
    """Solve a problem with the method that its file names, and say what was found and how that is known.

    The exit status is 0 if the run ended as asked, 1 if it did not, 2 if the file is wrong.
    """
    configure_jax()
    with in_words(f"read {file}"):
        plan = plan_in(file, settings, seed)
    with contextlib.ExitStack() as stack:
        stack.enter_context(in_words("keep the run"))
        if out is not None:
            stack.enter_context(kept(out, plan, certify=certify))
        finish(plan, out, certify, as_json)


def finish(plan: Any, out: Path | None, certify: bool, as_json: bool) -> None:
    """Solve, keep and show; exit with 1 where the run did not end as asked."""
    from perfcontrol.files.run import end
    from perfcontrol.solvers import Result

    with stages(transient=True) as show:
        run = solved(plan, lambda done, total: show("solving", done / total), KINDS if certify else ())
    if out is not None:
        end(out, run)
    cost = cost_of(run.problem, run.solution.M, run.seed)
    if as_json:
        print(json.dumps(data_of(run, cost), indent=2, allow_nan=False, ensure_ascii=False))
    else:
        _show(run, cost, out)
    raise typer.Exit(0 if run.solution.result == Result.success else 1)


def data_of(run: "Run", cost: dict[str, float | None]) -> dict[str, Any]:
    """A run as plain data."""
    import numpy as np

    from perfcontrol._printing import public_name
    from perfcontrol.solvers import Result
    from perfcontrol.theory.certificates.report import plain

    solution = run.solution
    return {
        "solver": public_name(run.solver),
        "result": Result[solution.result],
        "success": bool(solution.result == Result.success),
        "steps": int(solution.steps),
        "seconds": run.seconds,
        "seed": run.seed,
        **cost,
        "stats": {name: plain(np.asarray(value).tolist()) for name, value in solution.stats.items()},
        "policy": plain(np.asarray(solution.M).tolist()),
        "certificates": list(run.certificates),
    }


def _show(run: "Run", cost: dict[str, float | None], out: Path | None) -> None:
    def say(text: str) -> None:
        console.print(text, highlight=False, markup=False, soft_wrap=True)

    say(str(run.solution))
    error = "" if cost["standard_error"] is None else f" ± {cost['standard_error']:.2g}"
    say(f"  cost in the world that it makes: {cost['cost']:.6g}{error}; {run.seconds:.1f} s")
    for line in verdicts(run.certificates):
        say(line)
    if out is not None:
        say(f"kept in {out}")


def verdicts(rows: tuple[dict[str, Any], ...]) -> list[str]:
    """Whether a stable policy exists, by the strongest of the certificates, and which of them hold: a line each."""
    if not rows:
        return []
    known = sorted(
        (row for row in rows if row["exists"] is not None), key=lambda row: STATUSES.index(row["existence_status"])
    )
    best = known[0] if known else rows[0]
    verdict = {True: "a stable policy exists", False: "no stable policy exists", None: "existence is open"}[
        best["exists"]
    ]
    status = f" ({best['existence_status']})" if known else ""
    words = {True: "holds", False: "does not hold", None: "not applicable"}
    each = "; ".join(
        f"{row['kind']} {words[row['holds']]}" + (f", rate {row['rate']:.3g}" if row["holds"] else "") for row in rows
    )
    return [f"{verdict}{status}: {best['existence']}", f"certificates of contraction: {each}"]
