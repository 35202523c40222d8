"""Draws the figures that have no script of their own: the one of the README, and those of the page on reports.

python docs/figures.py [FOLDER]

FOLDER holds results of `make reproduce` (results/paper); what is missing there is run. The picture of a report is taken
by Chromium, and left as it is where there is none.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import perfcontrol as pc
from perfcontrol.config import ReproduceSettings
from perfcontrol.experiments.reproduce import reproduce
from perfcontrol.plotting.style import styled

IMAGES = Path(__file__).parent / "img"
STEP = pc.InverseStep(1.0, 2000.0)
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# The top of the report, and beside it two sections from further down, each in half of its size.
VIEWS = """<!doctype html><style>body { margin: 0; display: flex; zoom: 0.55 }</style>
<iframe src="report.html" width="1125" height="1130" frameborder="0"></iframe>
<iframe src="sections.html" width="1125" height="1130" frameborder="0"></iframe>"""
SECTIONS = "<style>header, nav, .short, section:not(#trajectories, #distribution) { display: none }</style></head>"
SIZE = "1238,620"


def example() -> pc.PerformativeProblem:
    """The problem of the README."""
    system = pc.LinearSystem(
        A=[[0.9, 0.2, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]], B=[[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]
    )
    return pc.PerformativeProblem(
        system=system,
        horizon=50,
        noise=pc.Uniform(-jnp.ones(3), jnp.ones(3)),
        cost=pc.QuadraticCost(Q=jnp.eye(3), R=0.1 * jnp.eye(2)),
        memory=2,
        gain=0.5 * pc.design_gain(system, Q=jnp.eye(3), R=jnp.eye(2)),
        perturbation=pc.DirectionalPerturbation([jnp.eye(3)], pc.Norm([0.1], [0.5], squared=True)),
    )


def draw_plots(problem: pc.PerformativeProblem, path: Path) -> None:
    """The figures of `pc.plotting` on six axes."""
    price, key = pc.price_of_stability(problem), jax.random.key(0)
    runs = {
        "RRM": pc.solve(problem, pc.RRM()),
        "RSGD, 16 seeds": pc.solve_many(
            problem, pc.RSGD(2000, STEP), keys=jax.random.split(key, 16), record=lambda M: M
        ),
    }
    with styled():
        figure, axes = plt.subplots(2, 3, figsize=(8.8, 5.0), layout="constrained")
        pc.plotting.plot_trajectories(problem, price, key=key, signals="u[0]", samples=2048, ax=axes[0, 0])
        pc.plotting.plot_costs(problem, price, key=key, samples=8192, ax=axes[0, 1])
        pc.plotting.plot_policy(problem, price.stable, ax=axes[0, 2])
        pc.plotting.plot_convergence(runs, price.stable, ax=axes[1, 0])
        pc.plotting.plot_certificate(pc.certify(problem, pc.Sharp(by_time=True)), ax=axes[1, 1])
        pc.plotting.plot_landscape(problem, price, view="line", ax=axes[1, 2])
        figure.savefig(path, dpi=150)


def picture_report(problem: pc.PerformativeProblem, path: Path) -> None:
    """Two views of a report, side by side."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print(f"{path} is left as it is: none of {', '.join(BROWSERS)} was found")
        return
    solution = pc.solve(problem, pc.RSGD(500, STEP), key=jax.random.key(0))
    with tempfile.TemporaryDirectory() as folder:
        page, sections, views = (Path(folder) / f"{name}.html" for name in ("report", "sections", "views"))
        pc.report(problem, {"RSGD": solution}, page)
        sections.write_text(page.read_text(encoding="utf-8").replace("</head>", SECTIONS, 1), encoding="utf-8")
        views.write_text(VIEWS, encoding="utf-8")
        options = ["--headless", "--disable-gpu", "--hide-scrollbars", f"--window-size={SIZE}"]
        options += ["--no-sandbox"] if os.geteuid() == 0 else []  # which Chromium demands of root
        subprocess.run([browser, *options, f"--screenshot={path}", views.as_uri()], check=True, capture_output=True)


def main(folder: Path) -> None:
    """All of them."""
    jax.config.update("jax_enable_x64", True)
    reproduce(folder, ReproduceSettings())
    shutil.copyfile(folder / "figure1_error.png", IMAGES / "figure1_error.png")
    draw_plots(example(), IMAGES / "plots.png")
    picture_report(example(), IMAGES / "report.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results/paper"))
