"""Where the stable policy lies, given an averaged run: an ellipsoid, and an interval for each parameter."""

from typing import Any

import equinox as eqx
import numpy as np
import scipy.special
from jaxtyping import Array

from perfcontrol._checks import fail
from perfcontrol.solvers.base import Solution
from perfcontrol.solvers.result import Result

ALIKE = 0.6  # correlation of neighbouring batches from which on their scatter says too little
MISSED = 1.5  # times as often as `level` says may the region miss because the start is still felt


class ConfidenceRegion(eqx.Module):
    """The ellipsoid {M : (M - centre)ᵀ covariance⁻¹ (M - centre) ≤ radius²}, in the directions that vary.

    Attributes:
        centre: the averaged iterate, `policy_shape`.
        covariance: of the average, (p, p), parameters in the order of centre.reshape(-1).
        level: the probability with which it contains the stable policy, asymptotically.
        radius: in standard deviations.
        half_axes: (rank, *policy_shape), from the centre to the surface, the longest first.
        lower: ends of the intervals that hold at `level` for each parameter alone, `policy_shape`.
        upper: likewise.
    """

    centre: np.ndarray
    covariance: np.ndarray
    level: float
    radius: float
    half_axes: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def contains(self, M: Any) -> bool:
        """Whether a policy lies in the region.

        Args:
            M: free policy parameters, `policy_shape`.
        """
        M = np.asarray(M, dtype=float)
        if M.shape != self.centre.shape:
            raise fail("M", str(M.shape), f"have shape {self.centre.shape}", "Pass free parameters, as `.centre` is.")
        offset = (M - self.centre).reshape(-1)
        axes = self.half_axes.reshape(len(self.half_axes), offset.size)
        along = axes @ offset / np.sum(axes**2, axis=1)  # 1 on the surface
        outside = np.linalg.norm(offset - along @ axes)
        slack = 1e-8 if self.centre.dtype == np.float64 else 1e-4
        return bool(along @ along <= 1 and outside <= slack * (1 + np.linalg.norm(self.centre)))


def confidence_region(solution: Solution, level: float = 0.95) -> ConfidenceRegion:
    """The region of an averaged run in which the stable policy lies with probability `level`, asymptotically.

    Chi-squared quantiles with the sandwich covariance, Hotelling's (and Student's) with batch means. It knows the
    sampling error alone. A run too short to have forgotten its start is off by more: with the sandwich, by so much that
    a region would miss half again as often as `level` says, it is refused; with batch means nothing tells.

    Args:
        solution: of one `pc.RSGD(..., average=True)` run.
        level: between 0 and 1.

    Returns:
        `ConfidenceRegion`.

    Raises:
        InputError: a solution without covariance or of several runs, a level outside (0, 1), batches too few or
            too alike, a run that failed or still feels its start, an average at the border of a set that is not
            affine, where the error is not normal.

    References:
        Cutler, Díaz and Drusvyatskiy (2022); docs: theory, "Averaged iterates".
    """
    if not (isinstance(level, int | float) and 0 < level < 1):
        raise fail("level", str(level), "lie between 0 and 1", "Pass for example 0.95.")
    if not isinstance(solution, Solution) or "covariance" not in solution.stats:
        raise fail(
            "solution",
            "one without an estimated covariance" if isinstance(solution, Solution) else type(solution).__name__,
            "come from an averaged run",
            "Solve with pc.RSGD(..., average=True).",
        )
    stats: dict[str, Array] = solution.stats
    covariance = np.asarray(stats["covariance"])
    if covariance.ndim != 2:
        raise fail("solution", f"a stack of {covariance.shape[:-2]} runs", "be of one run", "Take them one by one.")
    if solution.result != Result.success:
        raise fail(
            "solution",
            f"a run that ended otherwise: {Result[solution.result]}",
            "have succeeded",
            "Solve again until .result is success.",
        )
    averaged, clipped, batches = (int(stats[name]) for name in ("averaged", "clipped", "batches"))
    alike = float(stats["batch_correlation"])
    if clipped > 0.01 * averaged:
        raise fail(
            "solution",
            f"a run in which the feasible set cut {clipped} of {averaged} averaged steps short",
            "average in the interior of the set, or on an affine one",
            "Use several seeds, or pc.StablePoint where moments are known: at a border the error is not normal.",
        )
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2) if averaged else (np.full(1, np.nan), None)
    if not np.all(np.isfinite(values)) or vectors is None:
        raise fail("solution", "a run stopped before its average began", "have averaged", "Let it run to its end.")
    keep = values > 1e3 * np.finfo(covariance.dtype).eps * max(values[-1], 0)
    rank = int(keep.sum())
    if 0 < batches <= rank:
        raise fail("solution", f"{batches} complete batches", f"have more than {rank}", "Let the run go to its end.")
    if alike > ALIKE:
        raise fail(
            "solution",
            f"a run whose {batches} batches resemble their neighbours, with correlation {alike:.2g}",
            f"have batches that outlast the memory of the iteration (correlation below {ALIKE})",
            "Take more or longer steps; where moments are known, covariance='sandwich' needs neither.",
        )
    radius, width = _quantiles(level, rank, batches)
    along = vectors[:, keep].T @ np.asarray(stats["start_offset"], float).reshape(-1)
    missing = 1 - float(scipy.special.chndtr(radius**2, rank, along @ (along / values[keep]))) if rank else 0.0
    if missing > MISSED * (1 - level) and batches == 0:
        raise fail(
            "solution",
            f"a run whose average still feels its start, so that the region would miss in {missing:.0%}",
            f"miss in about {1 - level:.0%}",
            "Take more or longer steps (pc.PowerStep(eta, delay=...)), a larger burn_in, or a better start.",
        )
    centre = np.asarray(solution.M)
    half_axes = (radius * np.sqrt(values[keep]) * vectors[:, keep]).T[::-1].reshape(rank, *centre.shape)
    reach = width * np.sqrt(np.clip(np.diag(covariance), 0, None)).reshape(centre.shape)
    return ConfidenceRegion(centre, covariance, float(level), radius, half_axes, centre - reach, centre + reach)


def _quantiles(level: float, rank: int, batches: int) -> tuple[float, float]:
    """Radius of the region and half width of an interval, in standard deviations."""
    both = (1 + level) / 2
    if rank == 0:
        return 0.0, float(scipy.special.ndtri(both))
    if batches == 0:
        return float(np.sqrt(scipy.special.chdtri(rank, 1 - level))), float(scipy.special.ndtri(both))
    free = batches - rank
    squared = rank * (batches - 1) / free * scipy.special.fdtri(rank, free, level)
    return float(np.sqrt(squared)), float(scipy.special.stdtrit(batches - 1, both))
