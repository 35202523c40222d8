"""`perfcontrol simulate`."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from perfcontrol.cli.app import app, configure_jax, console, in_words
from perfcontrol.cli.plans import AsJson, File, Seed, Settings, plan_in

PERCENT = (5, 50, 95)


@app.command()
def simulate(
    file: File = Path("problem.toml"),
    policy: Annotated[
        Path | None, typer.Option(help="Run folder, solution (npz), or free parameters (NPY); that of the run itself.")
    ] = None,
    deployed: Annotated[
        Path | None, typer.Option(help="Policy that the world reacts to, likewise; the same one unless given.")
    ] = None,
    samples: Annotated[int, typer.Option(help="Paths.", min=2, max=1_000_000)] = 1000,
    horizon: Annotated[int | None, typer.Option(help="Stages, where the horizon is infinite.", min=2)] = None,
    out: Annotated[Path | None, typer.Option(help="Write all paths to this NetCDF file (.nc).")] = None,
    seed: Seed = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Simulate paths under a policy: what they cost, and where states and inputs go.

    Without --policy: the policy of a run; of a problem file its M0, or the feasible policy nearest to zero.
    """
    configure_jax()
    import jax
    import numpy as np

    from perfcontrol._checks import fail
    from perfcontrol.evaluate import simulate as paths_of

    if out is not None and out.suffix != ".nc":
        raise fail("out", f"{out}", "end in .nc", "Name it for example paths.nc: NetCDF is what xarray opens.")
    with in_words("read the problem and the policy"):
        plan = plan_in(file, settings, seed)
        M = _policy(policy, plan) if policy else _own(file, plan)
        other = None if deployed is None else _policy(deployed, plan)
    problem = plan.problem
    if not problem.is_finite:
        problem = problem.truncated(horizon or 1000)
    paths = paths_of(problem, M, deployed=other, key=jax.random.key(plan.seed), samples=samples)
    if not all(bool(np.isfinite(part).all()) for part in (paths.x, paths.u, paths.cost)):
        raise OverflowError("paths overflow under this policy: use a policy of smaller norm, or a shorter horizon.")
    cost = np.asarray(paths.cost)
    found: dict[str, Any] = {
        "samples": samples,
        "seed": plan.seed,
        "mean_cost": float(cost.mean()),
        "standard_error": float(cost.std(ddof=1) / np.sqrt(samples)),
        "expected_cost": _exact(problem, M, other),
        "cost_quantiles": {str(p): float(np.percentile(cost, p)) for p in PERCENT},
    }
    for name, values, names in (
        ("states", paths.x, plan.problem.system.state_names),
        ("inputs", paths.u, plan.problem.system.input_names),
    ):
        array = np.asarray(values)
        labels = names or [f"{'x' if name == 'states' else 'u'}{i}" for i in range(array.shape[-1])]
        found[name] = {
            label: {"mean": float(array[..., i].mean()), "deviation": float(array[..., i].std())}
            for i, label in enumerate(labels)
        }
    if out is not None:
        with in_words(f"write {out}"):
            _write(problem, paths, out, plan.seed)
    if as_json:
        print(json.dumps(found, indent=2, allow_nan=False, ensure_ascii=False))
    else:
        _show(found, problem.horizon, out)


def _exact(problem: Any, M: Any, deployed: Any) -> float | None:
    """The expected cost where moments are known: of heavy tails a sample mean says little."""
    from perfcontrol._checks import InputError
    from perfcontrol.evaluate import expected_cost

    try:
        return float(expected_cost(problem, M, deployed=deployed))
    except (InputError, OverflowError):
        return None


def _own(file: Path, plan: Any) -> Any:
    if file.is_dir():
        return _policy(file, plan)
    return plan.problem.initial_policy() if plan.M0 is None else plan.M0


def _policy(path: Path, plan: Any) -> Any:
    """The free parameters in a run, a solution or an NPY file."""
    import numpy as np

    from perfcontrol._checks import fail
    from perfcontrol.files import Run, load
    from perfcontrol.files.arrays import read_npy

    if path.suffix == ".npy":
        M = read_npy(path)
    else:
        held = load(path)
        if not hasattr(held, "M") and not isinstance(held, Run):
            raise fail("policy", f"{path}", "be a run, a solution (npz) or an array (npy)", "Run `perfcontrol solve`.")
        M = held.solution.M if isinstance(held, Run) else held.M
    return plan.problem.check_policy("policy", np.asarray(M))


def _write(problem: Any, paths: Any, out: Path, seed: int) -> None:
    import numpy as np
    import xarray

    from perfcontrol.results import save_dataset

    system = problem.system
    names = (("state", system.state_names), ("input", system.input_names))
    coordinates = {axis: list(labels) for axis, labels in names if labels}
    data = {
        "x": (("sample", "time", "state"), np.asarray(paths.x)),
        "u": (("sample", "time", "input"), np.asarray(paths.u)),
        "w": (("sample", "step", "state"), np.asarray(paths.w)),
        "cost": (("sample",), np.asarray(paths.cost)),
    }
    save_dataset(xarray.Dataset(data, coords=coordinates), out, {"seed": seed})


def _show(found: dict[str, Any], horizon: int, out: Path | None) -> None:
    from rich.table import Table

    low, middle, high = (found["cost_quantiles"][str(p)] for p in PERCENT)
    lines = [
        f"{found['samples']} paths of {horizon} steps, seed {found['seed']}",
        f"cost: mean {found['mean_cost']:.6g} ± {found['standard_error']:.2g}; "
        f"5 %, 50 %, 95 %: {low:.4g}, {middle:.4g}, {high:.4g}",
    ]
    exact, mean, error = found["expected_cost"], found["mean_cost"], found["standard_error"]
    if exact is not None:
        far = "; rare paths that are much dearer decide it" if abs(exact - mean) > 5 * error else ""
        lines.append(f"exact expected cost: {exact:.6g}{far}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    table = Table("signal", "mean", "standard deviation", caption="over time and paths")
    for kind in ("states", "inputs"):
        for label, numbers in found[kind].items():
            table.add_row(label, f"{numbers['mean']:.4g}", f"{numbers['deviation']:.4g}")
    console.print(table)
    if out is not None:
        console.print(f"wrote {out}", highlight=False, markup=False)
