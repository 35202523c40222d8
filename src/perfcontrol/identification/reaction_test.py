"""Does the plant react? A test of one law for all deployments, the sizes of what differs, what to deploy next."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from perfcontrol._checks import check_integer, check_key, fail
from perfcontrol.evaluate import Estimate
from perfcontrol.identification.common import Common, common_fit
from perfcontrol.identification.deviations import centred, estimated_deviations, score_deviations
from perfcontrol.identification.identify import check_directions
from perfcontrol.identification.logs import Logs
from perfcontrol.identification.next_policy import next_policy
from perfcontrol.identification.randomisation import combined, least_of, p_values, statistics_of
from perfcontrol.identification.transitions import Transitions, transitions_of
from perfcontrol.identification.unidentified import untold

NORMAL = 1.959963984540054
FEW = 8  # episodes (or blocks) of a deployment below which the test's approximation is poor
ALIKE = 0.05  # distance of policies, relative to their norms, below which they are hardly two


@dataclass(frozen=True, eq=False)
class Effect:
    """How much one part differs between deployments: root mean square, with a 95 % interval, and its own p-value.

    by_deployment: each deployment against the others; (G, n, n) for the mean (the change of A), else (G,).
    """

    size: float
    low: float
    high: float
    p_value: float
    by_deployment: Estimate


@dataclass(frozen=True, eq=False)
class ReactionTest:
    """What `pc.test_reaction` found.

    Attributes:
        p_value: of the hypothesis that nothing reacts; None where the logs cannot tell.
        effect: sizes by name: "mean" (shift of the predicted next state at a typical state, in standard deviations of
            its error), "perturbation" and "noise" (change of their share in the variance of that error), each with
            `.size .low .high .p_value .by_deployment`; empty where it cannot be told.
        next_policy: (memory, m, n), what to deploy next to learn most.
        missing: what cannot be told, in words.
    """

    p_value: float | None
    effect: dict[str, Effect]
    next_policy: np.ndarray
    missing: tuple[str, ...]

    def __str__(self) -> str:
        said = []
        if self.p_value is None:
            said.append("These logs cannot tell whether the plant reacts.")
        else:
            verdict = "The plant reacts" if self.p_value <= 0.05 else "No reaction is seen"
            said.append(f"{verdict} (p = {self.p_value:.3g}).")
        units = {
            "mean": "standard deviations",
            "perturbation": "of the error variance",
            "noise": "of the error variance",
        }
        for name, effect in self.effect.items():
            interval = f"{effect.low:.2g} to {effect.high:.2g}"
            said.append(f"{name.capitalize()}: {effect.size:.2g} {units[name]} ({interval}; p = {effect.p_value:.3g}).")
        if self.missing:
            said.append("Cannot be told: " + "; ".join(self.missing) + ".")
        rows = "; ".join(" ".join(f"{x:.3g}" for x in row) for lag in self.next_policy for row in lag)
        said.append(f"Most is learned by deploying next [{rows}].")
        return " ".join(said)


def test_reaction(
    logs: Logs,
    gain: Any = 0,
    memory: int | None = None,
    permutations: int = 999,
    key: Any = None,
    *,
    directions: Any = None,
    candidates: Any = None,
    radius: float | None = None,
) -> ReactionTest:
    """Test whether mean dynamics, perturbation covariance or noise differ between the deployments of some logs.

    Null: A, B and the laws of Δ and w are the same under every policy. Paths are not exchangeable under it, since the
    inputs follow the policy; so labels are not permuted. Each episode contributes a score at a common fit, freed of the
    error of that fit, which has mean zero under every policy; it changes its sign at random, `permutations` times. Two
    statistics are compared with themselves under these flips: the largest studentised change of an entry of A, or of
    the size of perturbations or noise, in any one deployment; and the sum over all deployments of squared changes of
    mean coefficients, or of entries of the covariances. The smaller of their p-values makes one p-value.

    Exact: given the flips, the p-value accounts for the choice among the statistics and for the number of flips.
    Asymptotic, in the number of episodes of each deployment: that flipped scores have the law of the observed ones, and
    that the common fit is near enough for its error to be freed to first order. No law need be Gaussian, symmetric or
    equal in different deployments; fourth moments of the residuals must exist. Fewer than 40 episodes in all are cut
    into blocks, whose scores are uncorrelated but not independent. The documentation has levels as measured.

    Args:
        logs: episodes under two or more policies.
        gain: as in `fit`.
        memory: as in `fit`.
        permutations: random changes of signs; the smallest possible p-value is 1 / (permutations + 1).
        key: JAX random key.
        directions: (k, n, n) of the perturbations if they are known: more power. None looks at any covariance.
        candidates: policies to choose the next one from; None looks within `radius` of the last one deployed.
        radius: Frobenius norm; None takes the largest distance between deployed policies.

    Returns:
        A `ReactionTest`; str() is a paragraph.

    Raises:
        InputError: logs, gain, memory or candidates that do not fit one another; no key.
    """
    data = transitions_of(logs, gain, memory)
    check_integer("permutations", permutations, 1)
    generator = np.random.default_rng(np.asarray(jax.random.key_data(check_key(key))).ravel())
    known = None if directions is None else check_directions(directions, data)
    if known is not None and known.shape[2] != data.x.shape[1]:
        raise fail("directions", f"{known.shape}", "act on the state alone", "Leave them out.")
    common = common_fit(data, known)
    chosen = next_policy(data, common, candidates, radius, generator)
    missing = _missing(data, common)
    if len(data.policies) == 1:
        return ReactionTest(None, {}, chosen, missing)
    signs = generator.choice([-1.0, 1.0], (permutations, len(data.group)))
    effects, statistics = _tested(data, common, signs)
    return ReactionTest(combined(statistics), effects, chosen, missing)


def _tested(data: Transitions, common: Common, signs: np.ndarray) -> tuple[dict[str, Effect], np.ndarray]:
    """The effects, and two statistics (P+1, 2): of a change in one place, and of one that is spread out."""
    group, n = data.group, data.x.shape[1]
    whole, states, root = _mean_coordinates(data, common)
    mean = statistics_of(score_deviations(common.mean, group, whole), group, signs).total.sum(axis=1)
    shift = estimated_deviations(common.mean, group, states)
    natural = common.root @ shift.reshape(*shift.shape[:2], n, -1) @ root.T
    entry = statistics_of(natural.reshape(*shift.shape[:2], -1), group, signs).largest.max(axis=1)

    sizes = np.stack([common.perturbation, common.noise], axis=1) / _shares(data, common)
    share = estimated_deviations(common.covariance, group, sizes)
    both = score_deviations(common.covariance, group, sizes.sum(axis=1, keepdims=True))
    size = statistics_of(np.concatenate([share, both], axis=2), group, signs).largest
    scale = 1 / np.sqrt(np.maximum(np.einsum("gpp->p", common.covariance.information), 1e-300))
    squares = statistics_of(score_deviations(common.covariance, group, np.diag(scale)), group, signs).total
    noisy = common.noise_entries
    of_squares = np.stack([squares[:, ~noisy].sum(axis=1), squares[:, noisy].sum(axis=1)], axis=1)

    in_one_place = np.maximum(entry, size.max(axis=1))
    spread_out = least_of(np.concatenate([mean[:, None], of_squares], axis=1))
    of_mean = combined(np.stack([entry, mean], axis=1))
    of_size = p_values(size)[0]
    effects = {
        "mean": _effect(shift, natural, group, of_mean, n),
        "perturbation": _effect(share[..., :1], share[..., 0], group, float(of_size[0]), 1),
        "noise": _effect(share[..., 1:], share[..., 1], group, float(of_size[1]), 1),
    }
    return effects, np.stack([in_one_place, spread_out], axis=1)


def _mean_coordinates(data: Transitions, common: Common) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Functionals of the mean coefficients in units of the error: all of them, those of the state; S^{-1/2} for x."""
    n, m = data.x.shape[1], data.v.shape[1]
    root, inputs = _inverse_root(data.x), _inverse_root(data.v)
    columns = np.zeros((n + m + 1, root.shape[1] + inputs.shape[1] + 1))
    columns[:n, : root.shape[1]] = root
    columns[n : n + m, root.shape[1] : -1] = inputs
    columns[-1, -1] = 1
    return np.kron(common.root, columns), np.kron(common.root, columns[:, : root.shape[1]]), root


def _inverse_root(z: np.ndarray) -> np.ndarray:
    """W (p, r) with z W of unit second moment, r the directions in which z moves."""
    values, vectors = np.linalg.eigh(z.T @ z / len(z))
    kept = values > 1e-12 * values.max(initial=0.0)
    return vectors[:, kept] / np.sqrt(values[kept])


def _shares(data: Transitions, common: Common) -> np.ndarray:
    """Average of tr(V⁻¹ 𝒞) / n for perturbations and noise as fitted, (2,): to count their changes in such shares."""
    information = common.covariance.information.sum(axis=0)
    whole = common.perturbation + common.noise
    parts = np.array([common.perturbation @ information @ whole, common.noise @ information @ whole])
    return np.maximum(np.abs(2 * parts / len(data.y) / data.x.shape[1]), 1e-12)


def _effect(values: np.ndarray, shown: np.ndarray, group: np.ndarray, p: float, n: int) -> Effect:
    """From contributions (U, G, J) in units of the error, and those to be shown."""
    total, residual = values.sum(axis=0).ravel(), centred(values, group)
    count = values.shape[1] * n
    bias, spread = float(np.sum(residual**2)), residual @ total
    square = (float(total @ total) - bias) / count
    error = np.sqrt(4 * float(spread @ spread) + 2 * float(np.sum((residual @ residual.T) ** 2))) / count
    low, size, high = (float(np.sqrt(max(square + d, 0.0))) for d in (-NORMAL * error, 0.0, NORMAL * error))
    deviation = np.sqrt(np.sum(centred(shown, group) ** 2, axis=0)).reshape(shown.shape[1:])
    return Effect(size, low, high, p, Estimate(jnp.asarray(shown.sum(axis=0)), jnp.asarray(deviation)))


def _missing(data: Transitions, common: Common) -> tuple[str, ...]:
    policies = data.policies.reshape(len(data.policies), -1)
    found = [gap.text for gap in untold(data, common.location)]
    if len(policies) == 1:
        return (*found, "any reaction: only one policy was deployed (deploy a second)")
    distance = np.linalg.norm(policies[:, None] - policies[None], axis=2).max()
    size = np.linalg.norm(policies, axis=1).max()
    if distance <= ALIKE * size:
        found.append(
            f"a reaction to larger changes: the policies differ by {distance / size:.2g} of their norm at most"
        )
    counts = np.bincount(data.group)
    for g in np.flatnonzero(counts < FEW):
        found.append(f"anything finer of policy {g}: {counts[g]} episodes are few for the approximation of the test")
    tried = int(np.linalg.matrix_rank(policies - policies[0], tol=1e-9 * size))
    if tried < policies.shape[1]:
        found.append(
            f"a reaction to {policies.shape[1] - tried} of {policies.shape[1]} directions of the policy: never tried"
        )
    return tuple(found)
