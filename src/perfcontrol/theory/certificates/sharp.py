"""The sharp certificate: what is true at the stable policy itself, found exactly, to first order."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from perfcontrol._checks import check_integer
from perfcontrol.problem import PerformativeProblem
from perfcontrol.solvers import Result
from perfcontrol.theory.assumptions import Assumption, reaction_status, word_of
from perfcontrol.theory.certificates.certificate import Certificate
from perfcontrol.theory.certificates.kind import AbstractCertificateKind
from perfcontrol.theory.derivatives import obstacles
from perfcontrol.theory.existence import Existence, existence
from perfcontrol.theory.stability.contraction import contraction_estimate
from perfcontrol.theory.stability.local_model import LocalModel, largest_mean_step, local_model, spectral_radius
from perfcontrol.theory.stability.rate_by_time import rate_by_time
from perfcontrol.theory.stability.safe_step import JACOBIAN_SAMPLES, stability_of
from perfcontrol.theory.stability.stable_policy import find_stable_policy, proves_absence


@dataclass(frozen=True, kw_only=True)
class Sharp(AbstractCertificateKind):
    """The local test at M^PS, with the steps that it allows.

    Args:
        M: the stable policy if it is known already, free parameters.
        batch: paths a step of RSGD.
        samples: of the gradient's Jacobian, for the mean-square step; 0 leaves that out.
        pairs: of policies for the global estimate; 0 leaves it out.
        by_time: whether to say what the reaction of each Δ_t adds to the rate (`.contributions`).
        key: JAX random key of these samples; a fixed one if None.

    Raises:
        InputError: a wrong number, or (in `pc.certify`) a policy of the wrong shape.

    References:
        docs: theory, "The sharp certificate".
    """

    M: Any = None
    batch: int = 1
    samples: int = JACOBIAN_SAMPLES
    pairs: int = 8
    by_time: bool = False
    key: Any = None

    name: ClassVar[str] = "sharp"
    title: ClassVar[str] = "The local test at the stable policy"
    endless: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, least in (("batch", 1), ("samples", 0), ("pairs", 0)):
            check_integer(name, getattr(self, name), least)

    def sentence(self, holds: bool, numbers: str, rate: float) -> str:
        if holds:
            return (
                f"{self.title} finds that repeated minimisation converges locally: spectral radius {numbers}, so that "
                f"near the stable policy each round shrinks the error by about {rate:.4g}."
            )
        return f"{self.title} finds no local convergence of repeated minimisation: spectral radius {numbers}."

    def assess(self, problem: PerformativeProblem) -> Certificate:
        exists, missing = existence(problem), obstacles(problem)
        if missing:
            return self.refuse(missing, exists)
        if self.M is None:
            solution = find_stable_policy(problem)
            M = solution.M
            if solution.result != Result.success:
                if exists.exists is None and proves_absence(problem):
                    return self._absent(problem)
                best = f"best residual {float(solution.stats['residual']):.2g}"
                missing = [f"the exact solvers found no stable policy ({best}): pass M=M if you know one"]
                return self.refuse(missing, exists)
        else:
            M = problem.check_policy("M", self.M)
        if exists.exists is None:
            found = Assumption("the stable policy, by its residual", "estimated")
            exists = Existence(True, "the exact solver found one, to a relative residual of 1e-11", (found,))
        return self._at(problem, local_model(problem, M), exists)

    def _at(self, problem: PerformativeProblem, model: LocalModel, exists: Existence) -> Certificate:
        """The verdict at a stable policy."""
        rate, mean_step = spectral_radius(model.response_jacobian), largest_mean_step(model)
        values: dict[str, Any] = {"M": np.asarray(model.M), "mean_field_stable": mean_step > 0, "mean_step": mean_step}
        values["mean_field_eigenvalues"] = np.linalg.eigvals(model.drift)
        notes = [
            f"The mean field of RSGD is stable for constant steps below {mean_step:.4g}."
            if mean_step > 0
            else "The mean field of RSGD is unstable at every step."
        ]
        assumptions = [
            Assumption("derivatives at the stable policy, in floating point", "estimated"),
            Assumption("active constraints are strictly active", "estimated"),
            *word_of(problem),
        ]
        if reaction_status(problem.perturbation) != "proved":
            assumptions.append(Assumption("the reaction is differentiable at the stable policy", "declared"))
        if not problem.is_finite:
            notes.append("Steps are on the gradient per stage. The mean-square test needs paths: problem.truncated(T).")
        elif self.samples and mean_step > 0:
            notes += self._mean_square(problem, model, mean_step, values)
            assumptions.append(Assumption("the mean-square step, from sampled Jacobians", "estimated"))
        if self.pairs:
            stretch = contraction_estimate(problem, pairs=self.pairs, key=self.key, center=model.M)
            values["contraction_estimate"] = stretch
            notes.append(
                f"Over sampled pairs of feasible policies, far ones included, the best response stretched distances by "
                f"at most {stretch:.3g} (an estimate; the test itself is only local)."
            )
        shares = rate_by_time(problem, model) if self.by_time else None
        if shares is not None and rate > 0:
            worst = int(np.argmax(shares))
            notes.append(f"The reaction at t = {worst} adds most to the rate ({shares[worst] / rate:.0%}).")
        return self.conclude(
            rate, 1.0, exists, tuple(assumptions), contributions=shares, values=values, notes=tuple(notes)
        )

    def _mean_square(
        self, problem: PerformativeProblem, model: LocalModel, mean_step: float, values: dict[str, Any]
    ) -> list[str]:
        """Adds the mean-square step and the error floor to `values`, and says them."""
        stability = stability_of(problem, model, mean_step, self.batch, self.samples, self.key)
        values["mean_square"] = stability
        values["mean_square_step"] = stability.threshold_estimate
        values["mean_square_step_error"] = stability.standard_error
        notes = [
            f"In mean square, with {self.batch} path{'s' * (self.batch > 1)} a step, RSGD is stable for constant steps "
            f"below {stability.threshold_estimate:.3g} (standard error {stability.standard_error:.1g}; steps are on "
            f"the gradient summed over stages)."
        ]
        floor_step = stability.threshold_estimate / 4
        if np.isfinite(floor_step) and floor_step > 0:
            values["error_floor"] = stability.error_floor(floor_step)
            floor = values["error_floor"]
            notes.append(f"At a quarter of that it settles at a mean-square error of {floor:.3g} about it.")
        return notes

    def _absent(self, problem: PerformativeProblem) -> Certificate:
        """The verdict where the affine equation for a stable policy has no solution."""
        rate = spectral_radius(local_model(problem, problem.initial_policy()).response_jacobian)
        affine = Assumption("the gradient field M -> g(M; M) is affine, checked at points", "estimated")
        none = Existence(False, "the equation for it is affine and has no solution", (affine,))
        return self.conclude(rate, 1.0, none, (), notes=("There is no stable policy to converge to.",))
