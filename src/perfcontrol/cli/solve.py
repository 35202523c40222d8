"""`perfcontrol solve`."""

import contextlib
import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from perfcontrol.cli.app import app, configure_jax, console, in_words
from perfcontrol.cli.plans import AsJson, File, Seed, Settings, cost_of, new_folder, plan_in, solved
from perfcontrol.cli.progress import stages

if TYPE_CHECKING:
    from perfcontrol.files.building import Plan
    from perfcontrol.files.run import Run

KINDS = ("paper", "rigorous", "global", "sharp")
STATUSES = ("proved", "declared", "estimated")  # from the strongest on
CHECKPOINT = "checkpoint"
ROWS, COLUMNS = 12, 8  # of a policy that is printed
NUDGE = 1e-6  # relative to the policy: how near the boundary of a set counts as on it


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

    A kept run that was stopped goes on with `perfcontrol resume RUN`. The exit status is 0 if the method ended as
    asked, 1 if it did not, 2 if the file is wrong.
    """
    configure_jax()
    from perfcontrol.files.run import begin

    with in_words(f"read {file}"):
        plan = plan_in(file, settings, seed)
    with contextlib.ExitStack() as stack:
        if out is not None:
            stack.enter_context(in_words(f"keep the run in {out}"))
            stack.enter_context(new_folder(out))
            begin(out, plan, certify=certify)
        carry_out(plan, out, certify, as_json)


def carry_out(plan: "Plan", out: Path | None, certify: bool, as_json: bool) -> None:
    """Solve, keep and show; exit with 1 where the method did not end as asked."""
    from perfcontrol.files.run import end
    from perfcontrol.solvers import Result

    checkpoint = None if out is None else out / CHECKPOINT
    with stages(transient=True) as show:
        run = solved(plan, show, KINDS if certify else (), checkpoint)
    if out is not None:
        end(out, run)
        shutil.rmtree(out / CHECKPOINT, ignore_errors=True)  # everything in it is in the run
    cost = cost_of(run.problem, run.solution.M, run.seed)
    if as_json:
        print(json.dumps(data_of(run, cost), indent=2, allow_nan=False, ensure_ascii=False))
    else:
        _show(run, cost, out)
    raise typer.Exit(0 if run.solution.result == Result.success else 1)


def data_of(run: "Run", cost: dict[str, Any]) -> dict[str, Any]:
    """A run as plain data."""
    import numpy as np

    from perfcontrol._printing import public_name
    from perfcontrol.solvers import Result

    solution = run.solution
    return {
        "solver": public_name(run.solver),
        "result": Result[solution.result],
        "success": bool(solution.result == Result.success),
        "steps": int(solution.steps),
        "seconds": run.seconds,
        "seed": run.seed,
        **cost,
        "stats": {name: _plain(np.asarray(value)) for name, value in solution.stats.items()},
        "policy": np.asarray(solution.M).tolist(),
        "certificates": list(run.certificates),
    }


def _plain(array: Any) -> Any:
    """Numbers as JSON holds them: whole ones stay whole, and what is not finite becomes a text."""
    from perfcontrol.theory.certificates.report import plain

    return plain(array.tolist()) if array.dtype.kind == "f" else array.tolist()


def _show(run: "Run", cost: dict[str, Any], out: Path | None) -> None:
    lines = [str(run.solution), f"  cost in the world that it makes: {said(cost)}; {run.seconds:.1f} s"]
    lines += _policy(run.problem, run.solution.M) + _boundary(run.problem, run.solution.M)
    lines += verdicts(run.certificates)
    if out is not None:
        lines.append(f"kept in {out}: perfcontrol simulate {out}, or pc.load({str(out)!r})")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _policy(problem: Any, M: Any) -> list[str]:
    """The policy in numbers, a line for each lag and input, where that is not too long."""
    import numpy as np

    policy = np.asarray(M)
    if policy[..., 0].size > ROWS or policy.shape[-1] > COLUMNS:
        return []
    named = problem.policy_shape == problem.lifted_shape
    inputs = (problem.system.input_names if named else None) or [f"u{i}" for i in range(policy.shape[1])]
    states = (problem.system.state_names if named else None) or [f"x{i}" for i in range(policy.shape[2])]
    width = max(10, *(len(name) + 2 for name in states))
    front = max(len(name) for name in inputs) + 9
    lines = ["policy: input by the noise of each state" + ", free parameters" * (not named)]
    lines.append(" " * (2 + front) + "".join(f"{name:>{width}}" for name in states))
    for lag, rows in enumerate(policy, start=1):
        for name, row in zip(inputs, rows, strict=True):
            lines.append(f"  {f'lag {lag}, {name}':<{front}}" + "".join(f"{value:>{width}.4g}" for value in row))
    return lines


def _boundary(problem: Any, M: Any) -> list[str]:
    """Whether the feasible set holds the policy back; nothing of sets that are all boundary, such as row sums."""
    inside, outside = (bool(problem.feasible_set.contains(M * scale, NUDGE / 100)) for scale in (1 - NUDGE, 1 + NUDGE))
    if outside or not inside:
        return []
    return ["the policy lies on the boundary of the feasible set: a larger set may have another one"]


def said(cost: dict[str, Any]) -> str:
    """A cost with its standard error, or why there is none."""
    if cost["cost"] is None:
        return cost["why"]
    return f"{cost['cost']:.6g}" + ("" if cost["standard_error"] is None else f" ± {cost['standard_error']:.2g}")


def verdicts(rows: tuple[dict[str, Any], ...]) -> list[str]:
    """Whether a stable policy exists, by the strongest of the certificates, and which of them hold: a line each."""
    if not rows:
        return []
    known = [row for row in rows if row["exists"] is not None]
    best = min(known, key=lambda row: STATUSES.index(row["existence_status"])) if known else rows[0]
    exists = {True: "a stable policy exists", False: "no stable policy exists", None: "existence is open"}
    status = f" ({best['existence_status']})" if known else ""
    words = {True: "holds", False: "does not hold", None: "not applicable"}
    each = "; ".join(
        f"{row['kind']} {words[row['holds']]}" + (f", rate {row['rate']:.3g}" if row["holds"] else "") for row in rows
    )
    return [f"{exists[best['exists']]}{status}: {best['existence']}", f"certificates of contraction: {each}"]
