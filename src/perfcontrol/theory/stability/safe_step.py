"""Constant steps of RSGD that are stable in mean square near the stable policy."""

from typing import Any

from perfcontrol._checks import fail
from perfcontrol.problem import PerformativeProblem, check_end
from perfcontrol.solvers import Result
from perfcontrol.theory.derivatives import obstacles
from perfcontrol.theory.precision import in_double
from perfcontrol.theory.stability.local_model import LocalModel, largest_mean_step, local_model
from perfcontrol.theory.stability.mean_square import MeanSquareStability, stability_at
from perfcontrol.theory.stability.stable_policy import find_stable_policy

JACOBIAN_SAMPLES = 512
SAFETY = 0.25


def stability_of(
    problem: PerformativeProblem, model: LocalModel, mean_step: float, batch: int, samples: int, key: Any
) -> MeanSquareStability:
    """The mean-square analysis of a local model."""
    return stability_at(
        problem,
        model.M,
        model.drift,
        model.basis,
        batch=batch,
        samples=samples,
        key=key,
        damping=model.damping,
        mean_threshold=mean_step,
    )


@in_double
def mean_square_stability(
    problem: PerformativeProblem,
    M: Any = None,
    *,
    batch: int = 1,
    samples: int = JACOBIAN_SAMPLES,
    key: Any = None,
) -> MeanSquareStability:
    """How large a constant step of RSGD may be near the stable policy, in mean square.

    Args:
        M: the stable policy; None finds it. batch: paths a step. samples: of the Jacobian of the gradient.
        key: JAX random key of the samples; a fixed one if None.

    Raises:
        InputError: no exact moments, too many parameters, or no stable policy found.

    References:
        docs: theory, "Mean-square stability".
    """
    missing = obstacles(check_end(problem))
    if missing:
        raise fail("problem", "; ".join(missing), "allow the exact local analysis", "Choose a step by trial runs.")
    if M is None:
        solution = find_stable_policy(problem)
        if solution.result != Result.success:
            raise fail(
                "problem", "none found", "have a stable policy", "Print pc.certify(problem, 'sharp'), which says why."
            )
        M = solution.M
    model = local_model(problem, problem.check_policy("M", M))
    return stability_of(problem, model, largest_mean_step(model), batch, samples, key)


def safe_step(problem: PerformativeProblem, batch: int = 1, *, safety: float = SAFETY, key: Any = None) -> float:
    """A constant step size for `pc.RSGD` that is stable in mean square near the stable policy, with a margin.

    step = safety × (threshold - 2 standard errors). The default leaves a factor four: the threshold is local, and
    where the reaction is strong, runs that start far away may grow from a third of it on.

    Args:
        problem: with a QuadraticCost and a perturbation of known moments.
        batch: paths a step of RSGD.
        safety: fraction of the threshold.
        key: JAX random key; a fixed one if None.

    Returns:
        The step, on the gradient of the cost summed over stages, as `pc.RSGD` takes it.

    Raises:
        InputError: as `mean_square_stability`; or no constant step is stable.
    """
    if not 0 < safety <= 1:
        raise fail("safety", repr(safety), "lie in (0, 1]", "Pass the fraction of the threshold to use.")
    stability = mean_square_stability(problem, batch=batch, key=key)
    threshold = stability.threshold_estimate - 2 * stability.standard_error
    if not threshold > 0:
        raise fail(
            "problem",
            f"a mean field with mean-step threshold {stability.mean_threshold:.3g}",
            "have a stable mean field for some constant step",
            "Retrain by pc.StablePoint, which does not need one, or weaken the reaction.",
        )
    return safety * threshold
