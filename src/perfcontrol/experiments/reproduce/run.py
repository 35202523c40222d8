"""The paper's numerical section, run again: every stage kept on disk as it ends, so that a killed run resumes.

Stages: `exact` (stable points without sampling), `optimum` (the cheapest policies, proved), `floors` (where theory sees
a small step end), `runs` (the paper's RSGD), `cure` (what mends the divergence), `sweep` (where divergence begins as
the step grows). Then figures and the table of claims. Runs keep every core busy; what is compiled or drawn on one core
goes on beside them.
"""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import jax
import xarray

from perfcontrol.config import ReproduceSettings
from perfcontrol.experiments.reproduce.cases import Progress, problems_of, silent
from perfcontrol.experiments.reproduce.divergence import cure_stage, floors_stage, sweep_stage
from perfcontrol.experiments.reproduce.exact import exact_stage, repeated_minimisation
from perfcontrol.experiments.reproduce.laboratory import laboratory, run_stage
from perfcontrol.experiments.reproduce.optimum import optimum_stage
from perfcontrol.experiments.reproduce.stages import Stages
from perfcontrol.reports.claims import Claim, as_markdown
from perfcontrol.reports.paper import judge
from perfcontrol.results import check_writable, save_json, save_text

STAGES = ("exact", "exact_simplex", "optimum", "floors", "runs", "cure", "sweep")


class Outcome(NamedTuple):
    """Where the work ended: files written, claims, seconds by stage."""

    files: list[Path]
    claims: list[Claim]
    seconds: dict[str, float]


def reproduce(out: Path, settings: ReproduceSettings, progress: Progress | None = None, fresh: bool = False) -> Outcome:
    """Run every stage, draw the figures, judge the claims, write all files under `out`.

    Args:
        out: folder, made if missing.
        settings: what to run.
        progress: called with (stage, share done).
        fresh: run stages again even where their results are there.

    Returns:
        Files written, claims, and seconds spent in each stage (0 for stages that were read).
    """
    if not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise RuntimeError('The reproduction needs float64: call jax.config.update("jax_enable_x64", True) first.')
    check_writable(out)
    progress = progress or silent
    stages = Stages(out, settings, fresh)
    problems, bounded_problems = problems_of(settings, settings.feasible_set), problems_of(settings, "simplex")

    def exact_and_repeated() -> xarray.Dataset:
        return repeated_minimisation(problems, exact_stage(problems, settings, progress), settings)

    with ThreadPoolExecutor() as pool:
        exact = pool.submit(stages.run, "exact", exact_and_repeated)
        bounded = [
            pool.submit(stages.run, "exact_simplex", lambda: exact_stage(bounded_problems, settings, silent))
            for _ in range(settings.simplex)
        ]
        optimal = pool.submit(stages.run, "optimum", lambda: optimum_stage(problems, progress))
        floors = pool.submit(stages.run, "floors", lambda: floors_stage(settings, exact.result()))
        lab = laboratory(settings, problems, exact.result)
        bounded_labs = [laboratory(settings, bounded_problems, stable.result) for stable in bounded]
        runs = stages.run("runs", lambda: run_stage(lab, problems, settings, progress))
        optimum = optimal.result()
        figures = pool.submit(stages.timed, "figures", lambda: _figures().draw_runs(out, runs, optimum))
        cure = stages.run("cure", lambda: cure_stage(lab, bounded_labs, settings, progress))
        sweep = stages.run("sweep", lambda: sweep_stage(lab, settings, progress))
        cure, files = cure.merge(floors.result()), figures.result()
        cured = pool.submit(stages.timed, "figures", lambda: _figures().draw_cure(out, cure, sweep, settings))
        exact_bounded = bounded[0].result() if bounded else None
        claims = stages.timed(
            "claims", lambda: judge(exact.result(), exact_bounded, optimum, runs, cure, sweep, settings)
        )
        save_json([claim.as_dict() for claim in claims], out / "claims.json")
        save_text(as_markdown(claims, settings.model_dump()), out / "claims.md")
        files += cured.result()
    data = [out / f"{stage}.nc" for stage in STAGES if stage in stages.seconds]
    return Outcome([*data, out / "claims.json", out / "claims.md", *files], claims, stages.seconds)


def _figures() -> ModuleType:
    from perfcontrol.plotting import paper_figures  # Matplotlib takes a while to import

    return paper_figures
