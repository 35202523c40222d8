"""What the constants of the theory are made of: numbers read from a problem, each with how it is known."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from perfcontrol.perturbations import SampledPerturbation
from perfcontrol.problem import PerformativeProblem
from perfcontrol.theory.assumptions import Assumption, word_of
from perfcontrol.theory.certificates.cost_constants import cost_constants, spectral_norms
from perfcontrol.theory.certificates.declarations import SERIES, Declarations
from perfcontrol.theory.facts import facts
from perfcontrol.theory.stability.strong_stability import check_per_step

FROM_NORMS = Assumption("the constants follow from norms of the problem's matrices and laws", "proved")
FIXED_NOISE = "the noise reacts to the policy: pass a fixed law, such as noise=pc.Uniform(low, high)"


@dataclass(frozen=True)
class Ingredients:
    """Sizes and norms of one problem. Entries that are not known are NaN and named in `missing`.

    initial_bound: x_0 ≥ ‖x_0‖. noise_bound: W. policy_bound: sup ‖M‖_F of lifted policies. input_norm: max ‖B_t‖.
    gain_norm: max ‖K_t‖. perturbation_bound, sensitivity: ξ_t and ε_t (T,), ε_t per unit of the free parameters.
    strong_convexity, smoothness, gradient_bound: μ_t, ς_t, G_t, (T+1,); ς joint in (x, u);
    ‖∇_x c‖, ‖∇_u c‖ ≤ G_t max(‖x‖, ‖u‖) + gradient_offset_t. noise_floor: λ_min of Cov(w_t), the smallest over t;
    quiet_direction: its eigenvector. structure_norm: ‖𝓛‖ of the lift.
    """

    horizon: int
    memory: int
    state_size: int
    initial_bound: float
    noise_bound: float
    policy_bound: float
    input_norm: float
    gain_norm: float
    perturbation_bound: np.ndarray
    sensitivity: np.ndarray
    strong_convexity: np.ndarray
    smoothness: np.ndarray
    gradient_bound: np.ndarray
    gradient_offset: np.ndarray
    noise_floor: float
    quiet_direction: np.ndarray
    noise_mean: float
    structure_norm: float
    missing: tuple[str, ...]
    assumptions: tuple[Assumption, ...]


def gather(problem: PerformativeProblem, declared: Declarations | None = None) -> Ingredients:
    """Read the ingredients of a problem; what the user declares goes before what the problem knows.

    Raises:
        InputError: a declared series of the wrong length.
    """
    declared = declared or Declarations()
    T = problem.horizon
    read = facts(problem)
    missing: list[str] = [FIXED_NOISE] if problem.noise_reacts else []
    assumptions: list[Assumption] = []

    def known(name: str, own: Any, what: str, remedy: str) -> Any:
        """The declared value of a size, or the problem's own."""
        if (given := declared.declared(name)) is not None:
            size = f" {float(given):.4g}" if given.ndim == 0 else ""
            assumptions.append(Assumption(what + size, "declared"))
            return given
        if own is None:
            missing.append(f"{what} is not known: pass {declared.examples[name]}, or {remedy}")
            return np.nan
        if name in SERIES and isinstance(problem.perturbation, SampledPerturbation):
            assumptions.append(Assumption(what, "declared"))
        return own

    def series(name: str, *others: Any) -> np.ndarray:
        value = known(name, *others)
        return np.full(T, np.nan) if value is np.nan else check_per_step(name, value, T)

    lifted = None if read.radius is None else problem.structure.norm * float(read.radius)
    floor, quiet_direction = _quietest(read.noise_covariance.astype(float))
    constants, cost_missing, cost_assumptions = cost_constants(problem, declared)
    initial_bound = known(
        "initial_bound",
        read.initial_bound,
        "the bound of the initial state",
        "a law that has one, such as initial_state=pc.Uniform(low, high)",
    )
    noise_bound = known(
        "noise_bound",
        read.noise_bound,
        "the bound W of the noise",
        "a law that has one, such as noise=pc.Uniform(low, high)",
    )
    policy_bound = known(
        "policy_bound",
        lifted,
        "the largest norm of a feasible policy (the set is unbounded)",
        "a bounded set, such as feasible_set=pc.FrobeniusBall(1.0)",
    )
    perturbation_bound = series(
        "perturbation_bound",
        read.perturbation_bound,
        "the almost-sure bound of the perturbations",
        "scales that know theirs on a bounded set, such as pc.Affine(offset, slope) or pc.Norm(offset, weight)",
    )
    sensitivity = series(
        "sensitivity",
        read.sensitivity,
        "the sensitivity of the perturbation law",
        "maps that know theirs, such as pc.Affine(offset, slope) or, on a bounded set, pc.Norm(offset, weight); "
        "pc.estimate_sensitivity(problem, key=key) samples it",
    )
    return Ingredients(
        horizon=T,
        memory=problem.memory,
        state_size=problem.state_size,
        initial_bound=float(initial_bound),
        noise_bound=float(noise_bound),
        policy_bound=float(policy_bound),
        input_norm=float(np.max(spectral_norms(problem.system.B))),
        gain_norm=float(np.max(spectral_norms(problem.gain))),
        perturbation_bound=perturbation_bound,
        sensitivity=sensitivity,
        strong_convexity=constants.strong_convexity,
        smoothness=constants.smoothness,
        gradient_bound=constants.gradient_bound,
        gradient_offset=constants.gradient_offset,
        noise_floor=floor,
        quiet_direction=quiet_direction,
        noise_mean=float(np.max(np.linalg.norm(read.noise_mean, axis=-1))),
        structure_norm=problem.structure.norm,
        missing=(*missing, *cost_missing),
        assumptions=(*assumptions, *cost_assumptions, *word_of(problem)),
    )


def _quietest(covariances: np.ndarray) -> tuple[float, np.ndarray]:
    """The smallest eigenvalue of the covariances of the noise, zero where it is rounding, and its eigenvector."""
    values, vectors = np.linalg.eigh(covariances if covariances.ndim == 3 else covariances[None])
    quietest = int(np.argmin(values[:, 0]))
    floor = float(values[quietest, 0])
    rounding = 1e-12 * max(float(values.max()), np.finfo(float).tiny)
    return 0.0 if floor <= rounding else floor, vectors[quietest, :, 0]
