"""`python -m benchmarks.methods [--out FOLDER]`: which method when; error against deployments and against time.

Prints the tables of docs/which-method.md; with `--out` also writes the figure there. Some ten minutes.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402 - after JAX is configured
import numpy as np  # noqa: E402

import perfcontrol as pc  # noqa: E402
from perfcontrol.response.projected import projection_slope  # noqa: E402
from perfcontrol.solvers.averaging import mean_field_jacobian  # noqa: E402

SEEDS = 5
STEPS = 10_000  # of the sampling methods with one episode a step
BATCH, LAZY = 16, 10
DEPLOYMENTS = (10, 100, 1000, 10_000)
LEVELS = (0.1, 0.02)
AWAY = 100.0
FLOOR = 1e-10  # what exact methods reach by their tolerance


class Trace(NamedTuple):
    """Errors ‖M - M^PS‖ / ‖M^PS‖ after so many deployments and seconds of processor time, the start included."""

    deployments: np.ndarray
    seconds: np.ndarray
    errors: np.ndarray
    ended: bool  # by itself, so that the last error stands from then on

    def after(self, deployments: int) -> float | None:
        """The error, where the run went that far."""
        if deployments > self.deployments[-1] and not self.ended:
            return None
        return float(self.errors[np.searchsorted(self.deployments, deployments, side="right") - 1])

    def time_to(self, error: float) -> float | None:
        """Seconds until the error falls below, where it does."""
        below = np.flatnonzero(self.errors <= error)
        return float(self.seconds[below[0]]) if len(below) else None


# --- problem classes -------------------------------------------------------------------------------------------------


def reacting(
    restless: float, copied: float, cost: pc.AbstractCost | None = None, horizon: int = 50
) -> pc.PerformativeProblem:
    """Three states, two inputs, two lags: a plant whose growth rates scatter by 0.1 + `restless` ‖M‖², and
    which by itself does with its state `copied` times what the policy does with the last noise."""
    system = pc.LinearSystem([[0.9, 0.2, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.7]], [[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])
    slope = np.zeros((3, 3, 2, 2, 3))
    for j in range(3):
        slope[:, j, 0, :, j] = copied * np.asarray(system.B)
    return pc.PerformativeProblem(
        system=system,
        horizon=horizon,
        memory=2,
        gain=pc.design_gain(system, Q=np.eye(3), R=np.eye(2)),
        noise=pc.Uniform(-np.ones(3), np.ones(3)),
        cost=quadratic() if cost is None else cost,
        perturbation=pc.DirectionalPerturbation(
            [np.eye(3)], pc.Norm([0.1], [restless], squared=True), mean=pc.Affine(np.zeros((3, 3)), slope)
        ),
    )


def quadratic() -> pc.QuadraticCost:
    return pc.QuadraticCost(np.eye(3), 0.1 * np.eye(2))


CLASSES: dict[str, Callable[[], pc.PerformativeProblem]] = {
    "mild": lambda: reacting(0.5, 0.0),
    "slow": lambda: reacting(0.1, -0.6),
    "overreacting": lambda: reacting(0.1, 1.3),
    "Huber": lambda: reacting(0.5, 0.0, pc.ConvexCost(pc.Huber(1.0, np.ones(3), 0.1 * np.ones(2))), 20),
    "stock market": lambda: pc.experiments.stock_market("descending", growth=1.0),
}


def stable_policy(problem: pc.PerformativeProblem) -> jax.Array:
    """M^PS; with a cost that is not quadratic, to 0.5 %."""
    exact = isinstance(problem.cost, pc.QuadraticCost)
    solver = pc.StablePoint() if exact else pc.StablePoint(5e-3)
    return pc.solve(problem, solver, key=jax.random.key(99)).M


# --- methods ---------------------------------------------------------------------------------------------------------


class Steps(NamedTuple):
    """Step sizes as theory would have them: below the mean-square threshold, then falling like 2 / (μ n), μ being the
    smallest real part of the eigenvalues of ∂g(M; M)."""

    problem: pc.PerformativeProblem  # with a quadratic cost
    slowest: float  # μ
    largest: float  # ‖∂g(M; M)‖

    def first(self, batch: int) -> float:
        return pc.safe_step(self.problem, batch, key=jax.random.key(7))

    def falling(self, batch: int = 1, share: float = 1.0) -> pc.InverseStep:
        phi1 = 2 / self.slowest
        return pc.InverseStep(phi1, phi1 / (share * self.first(batch)))

    def averaged(self) -> pc.PowerStep:
        first = self.first(1)
        return pc.PowerStep(first, 0.6, delay=1 / (first * self.slowest))


def steps_of(problem: pc.PerformativeProblem, stable: jax.Array) -> Steps:
    """For a Huber cost those of the quadratic that it never exceeds in curvature."""
    if not isinstance(problem.cost, pc.QuadraticCost):
        problem = reacting(0.5, 0.0, horizon=20)
        stable = stable_policy(problem)
    jacobian = np.asarray(mean_field_jacobian(problem, stable))
    tangent = projection_slope(problem.feasible_set, stable)
    eigenvalues = np.linalg.eigvals(tangent @ jacobian @ tangent)
    varying = np.abs(eigenvalues) > 1e-9 * np.abs(eigenvalues).max()  # not across an affine set
    return Steps(problem, float(eigenvalues.real[varying].min()), float(np.linalg.norm(jacobian, 2)))


def computing(problem: pc.PerformativeProblem, steps: Steps) -> dict[str, pc.AbstractSolver]:
    """Methods that need the model: they deploy inside the computer."""
    exact = isinstance(problem.cost, pc.QuadraticCost)
    tolerance = None if exact else 0.02  # of sampled answers
    methods: dict[str, pc.AbstractSolver] = {
        "StablePoint()": pc.StablePoint(tolerance),
        "RRM()": pc.RRM(tolerance, max_steps=300),
        "RRM(anderson=3)": pc.RRM(tolerance, max_steps=300, anderson=3),
        "RRM(inner_steps=3)": pc.RRM(tolerance, max_steps=300, inner_steps=3),
    }
    if exact:
        methods["RSGD, Exact"] = pc.RSGD(1000, 1 / steps.largest, gradient=pc.Exact())
    return methods


def sampling(steps: Steps, size: int) -> dict[str, pc.RSGD]:
    """Methods that need episodes alone."""
    return {
        "RSGD": pc.RSGD(STEPS, steps.falling()),
        f"RSGD, batch {BATCH}": pc.RSGD(STEPS // BATCH, steps.falling(BATCH), batch=BATCH),
        "RSGD, average": pc.RSGD(
            STEPS, pc.PowerStep(steps.first(1), 0.6), average=pc.Average(covariance="batch means")
        ),
        f"RSGD, Lazy({LAZY})": pc.RSGD(STEPS, steps.falling(), schedule=pc.Lazy(LAZY)),
        "RSGD, TwoPoint": pc.RSGD(STEPS, steps.falling(share=1 / size), gradient=pc.TwoPoint(0.1)),
        f"RSGD, EstimatedDynamics, batch {BATCH}": pc.RSGD(
            STEPS // BATCH, steps.falling(BATCH), batch=BATCH, gradient=pc.EstimatedDynamics()
        ),
    }


# --- measuring -------------------------------------------------------------------------------------------------------


def relative_errors(history: Any, stable: jax.Array) -> np.ndarray:
    away = np.asarray(history - stable).reshape(len(history), -1)
    return np.linalg.norm(away, axis=1) / float(jnp.linalg.norm(stable))


def trace_of(problem: pc.PerformativeProblem, solver: pc.AbstractSolver, stable: jax.Array, seed: int) -> Trace:
    """One run, compiled before."""
    clock: list[float] = []
    began = time.process_time()
    solution = pc.solve(
        problem, solver, key=jax.random.key(seed), throw=False, progress=lambda *_: clock.append(time.process_time())
    )
    jax.block_until_ready(solution.M)
    ended = time.process_time()
    taken = int(solution.steps)
    errors = relative_errors(solution.history[: taken + 1], stable)
    if isinstance(solver, pc.RSGD):  # steps of equal length
        every = getattr(solver.schedule, "steps", 1)
        keep = np.arange(0, taken + 1, every)
        return Trace(keep // every, keep * (ended - began) / taken, errors[keep], taken < solver.steps)
    return Trace(np.arange(taken + 1), np.append(0.0, np.asarray(clock) - began), errors, True)


def median_of(traces: list[Trace]) -> Trace:
    """Of runs of different lengths: the ends of the shorter ones go on. The quickest clock, others were disturbed."""
    longest = max(traces, key=lambda trace: len(trace.errors))
    count = len(longest.errors)
    errors = [np.pad(trace.errors, (0, count - len(trace.errors)), "edge") for trace in traces]
    seconds = np.min([trace.seconds for trace in traces if len(trace.errors) == count], axis=0)
    return Trace(longest.deployments, seconds, np.median(errors, axis=0), longest.ended)


def measured(name: str) -> dict[str, Trace]:
    """The median run of each method on a class of problems."""
    problem = CLASSES[name]()
    stable = stable_policy(problem)
    steps = steps_of(problem, stable)
    methods = computing(problem, steps) | sampling(steps, stable.size)
    traces = {}
    for label, solver in methods.items():
        runs = [trace_of(problem, solver, stable, seed) for seed in range(1 + SEEDS)]
        traces[label] = median_of(runs[1:])  # the first one compiled
        print(f"{name}: {label}: {traces[label].errors[-1]:.2g}", flush=True)
    return traces


def shown(error: float | None) -> str:
    if error is None:
        return "–"
    if not error <= AWAY:
        return "runs away"
    if error < FLOOR:
        return f"< {FLOOR:.0e}"
    return f"{error:.2g}" if error >= 1e-3 else f"{error:.0e}".replace("e-0", "e-")


def milliseconds(seconds: float | None) -> str:
    return "–" if seconds is None else f"{1e3 * seconds:.2g}" if seconds < 0.1 else f"{1e3 * seconds:.0f}"


def table(traces: dict[str, Trace]) -> str:
    """Errors after so many deployments; processor time of a deployment, and until errors are below some levels."""
    heads = [f"{count:,} depl." for count in DEPLOYMENTS] + ["ms / depl."] + [f"ms to {error:.0%}" for error in LEVELS]
    lines = ["| method | " + " | ".join(heads) + " |", "|---" + "|--:" * len(heads) + "|"]
    for label, trace in traces.items():
        values = [shown(trace.after(count)) for count in DEPLOYMENTS]
        values += [milliseconds(trace.seconds[-1] / trace.deployments[-1])]
        values += [milliseconds(trace.time_to(error)) for error in LEVELS]
        lines.append(f"| `{label}` | " + " | ".join(values) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder for which_method.png")
    parser.add_argument("--only", choices=CLASSES, help="one class of problems")
    arguments = parser.parse_args()
    names = [arguments.only] if arguments.only else list(CLASSES)
    traces = {name: measured(name) for name in names}
    print("\n\n".join(f"**{name}**\n\n{table(found)}" for name, found in traces.items()))
    if arguments.out is not None:
        from benchmarks.methods_figure import draw

        draw(traces, arguments.out / "which_method.png")


if __name__ == "__main__":
    main()
