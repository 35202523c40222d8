"""The test of a reaction: its pieces against dense regressions and slow loops, the whole on worlds that are known."""

import jax
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.identification.deviations import centred, estimated_deviations, score_deviations
from perfcontrol.identification.moments import Sums
from perfcontrol.identification.randomisation import combined, p_values, statistics_of
from tests.identification.worlds import small_policies, small_world
from tests.tools import assert_close, assert_refused

WORLD = small_world().but(scale=lambda M: np.array([0.3]))
POLICIES = small_policies()
LOGS = pc.Logs(*WORLD.logs(1, POLICIES[:3], 20, 15))
PART = np.array([[0.0, 0.4], [0.0, 0.0]])


def reaction_of(logs: pc.Logs = LOGS, gain: object = WORLD.K, key: int | None = 0, **options) -> pc.ReactionTest:
    return pc.test_reaction(logs, gain, key=None if key is None else jax.random.key(key), **options)


def regression() -> tuple[np.ndarray, np.ndarray, np.ndarray, Sums]:
    """Rows, targets, the group of each unit, and scores and information of y = X β at the common least squares."""
    r = np.random.default_rng(0)
    group, X, y = np.repeat([0, 1, 2], [5, 7, 6]), r.standard_normal((18, 10, 3)), r.standard_normal((18, 10))
    common = np.linalg.lstsq(X.reshape(-1, 3), y.ravel())[0]
    score = np.einsum("utp,ut->up", X, y - X @ common)
    return (
        X,
        y,
        group,
        Sums(score, np.stack([np.einsum("utp,utq->pq", X[group == g], X[group == g]) for g in range(3)])),
    )


def test_contributions_add_up_to_the_scores_of_each_deployment() -> None:
    _, _, group, sums = regression()
    functional = np.random.default_rng(1).standard_normal((3, 2))
    total = np.stack([sums.score[group == g].sum(axis=0) for g in range(3)])
    assert_close(score_deviations(sums, group, functional).sum(axis=0), total @ functional, 1e-9)


def test_contributions_do_not_feel_an_error_of_the_common_fit() -> None:
    _, _, group, sums = regression()
    per_unit = sums.information[group] / np.bincount(group)[group][:, None, None]
    wrong = np.array([0.3, -0.1, 0.2])  # by which the common coefficients are off
    moved = Sums(sums.score + per_unit @ wrong, sums.information)
    functional = np.eye(3)
    before, after = (score_deviations(s, group, functional).sum(axis=0) for s in (sums, moved))
    assert_close(after, before, 1e-9)


def test_estimated_deviations_are_a_regression_with_one_more_column_for_the_deployment() -> None:
    X, y, group, sums = regression()
    functional = np.array([[1.0], [0.5], [-0.2]])
    found = estimated_deviations(sums, group, functional).sum(axis=0)
    for g in range(3):
        own = (group == g)[:, None, None] * (X @ functional)
        design = np.concatenate([X, own], axis=2).reshape(-1, 4)
        assert_close(found[g, 0], np.linalg.lstsq(design, y.ravel())[0][3], 1e-9)


def test_statistics_match_a_loop_over_flips_deployments_and_coefficients() -> None:
    r = np.random.default_rng(2)
    group = np.repeat([0, 1], [4, 6])
    contributions, signs = r.standard_normal((10, 2, 3)), r.choice([-1.0, 1.0], (5, 10))
    about = centred(contributions, group).reshape(contributions.shape)
    T = np.zeros((6, 2, 3))
    for row in range(6):
        for j in range(3):
            for g in range(2):
                a = contributions[:, g, j] if row == 0 else signs[row - 1] * about[:, g, j]
                parts = [a[group == h] for h in (0, 1)]
                variance = sum(len(part) * part.var(ddof=1) for part in parts)
                T[row, g, j] = a.sum() ** 2 / variance
    found = statistics_of(contributions, group, signs)
    assert_close(found.largest, T.max(axis=1), 1e-10)
    assert_close(found.total, T.sum(axis=1), 1e-10)


def test_p_values_count_the_rows_that_are_at_least_as_large() -> None:
    r = np.random.default_rng(3)
    statistics = r.integers(0, 6, (20, 3)).astype(float)
    slow = np.array([[np.mean(statistics[:, k] >= statistics[i, k]) for k in range(3)] for i in range(20)])
    assert_close(p_values(statistics), slow, 1e-12)
    assert combined(statistics) == pytest.approx(np.mean(slow.min(axis=1) <= slow[0].min()))


def test_combined_p_value_keeps_its_level_where_rows_are_exchangeable() -> None:
    r = np.random.default_rng(4)
    rejected = np.mean([combined(r.standard_normal((400, 3)).cumsum(axis=1)) <= 0.05 for _ in range(2000)])
    assert 0.035 < rejected < 0.06


@pytest.mark.parametrize("part", ["mean", "perturbation", "noise"])
def test_what_reacts_is_told_apart_and_its_size_lies_in_the_interval(part: str) -> None:
    other = {
        "mean": WORLD.but(A=WORLD.A + PART),
        "perturbation": WORLD.but(scale=lambda M: np.array([0.75])),
        "noise": WORLD.but(noise=2 * WORLD.noise),
    }[part]
    logs = pc.Logs(*WORLD.logs(5, POLICIES[:1], 60, 25)) + pc.Logs(*other.logs(6, POLICIES[1:2], 60, 25))
    result = reaction_of(logs)
    assert result.p_value is not None and result.p_value <= 0.01 and "The plant reacts" in str(result)
    assert result.effect[part].p_value <= 0.01
    assert all(effect.p_value > 0.01 for name, effect in result.effect.items() if name != part)
    effect = result.effect[part]
    assert 0 < effect.low < effect.size < effect.high
    by_deployment = effect.by_deployment
    if part == "mean":
        gap = np.abs(np.asarray(by_deployment.mean) - np.stack([-PART, PART]))
        assert np.all(gap < 5 * np.asarray(by_deployment.standard_error))
    else:
        assert by_deployment.mean[0] < 0 < by_deployment.mean[1]


def test_a_change_of_one_entry_in_one_of_five_deployments_is_seen() -> None:
    moved = WORLD.but(A=WORLD.A + 0.65 * PART)
    logs = pc.Logs(*moved.logs(15, POLICIES[:1], 40, 10)) + pc.Logs(*WORLD.logs(16, POLICIES[1:], 40, 10))
    result = reaction_of(logs)
    change = result.effect["mean"].by_deployment
    assert 4.5 < change.mean[0, 0, 1] / change.standard_error[0, 0, 1] < 5.5
    assert result.p_value is not None and result.p_value <= 0.02


def test_known_directions_leave_no_less_to_see() -> None:
    logs = pc.Logs(*WORLD.logs(7, POLICIES[:1], 30, 20))
    logs += pc.Logs(*WORLD.but(scale=lambda M: np.array([0.6])).logs(8, POLICIES[1:2], 30, 20))
    known, unknown = reaction_of(logs, directions=WORLD.directions), reaction_of(logs)
    assert known.p_value is not None and known.p_value <= 0.01
    assert known.effect["perturbation"].p_value <= unknown.effect["perturbation"].p_value + 0.01


@pytest.mark.slow
def test_a_twentieth_of_the_worlds_without_a_reaction_is_rejected() -> None:
    rejected = [
        reaction_of(pc.Logs(*WORLD.logs(seed, POLICIES[:3], 30, 20)), permutations=199, key=seed).p_value <= 0.05
        for seed in range(400)
    ]
    assert 0.02 <= np.mean(rejected) <= 0.085  # three standard deviations of a binomial about 5 %


def test_the_same_key_gives_the_same_p_value_and_another_one_nearly_the_same() -> None:
    first, again, other = (reaction_of(key=key).p_value for key in (0, 0, 1))
    assert first == again and abs(first - other) < 0.1


def test_one_deployment_tells_nothing_and_says_so() -> None:
    result = reaction_of(pc.Logs(*WORLD.logs(9, POLICIES[1:2], 20, 15)))
    assert result.p_value is None and result.effect == {}
    assert any("only one policy" in text for text in result.missing)
    assert "cannot tell whether the plant reacts" in str(result) and result.next_policy.shape == (1, 1, 2)


def test_policies_that_are_nearly_one_are_named() -> None:
    twins = [POLICIES[1], POLICIES[1] * 1.01]
    result = reaction_of(pc.Logs(*WORLD.logs(10, twins, 20, 15)))
    assert any("differ by 0.0099 of their norm" in text for text in result.missing)


def test_inputs_that_never_moved_and_few_episodes_are_named() -> None:
    x, u, deployed = WORLD.logs(11, POLICIES[:1], 60, 15)
    deployed[30:] = POLICIES[1]  # deployed, but the inputs were those of the feedback alone
    result = reaction_of(pc.Logs(x, u, deployed))
    assert any("B along the input direction [1]" in text for text in result.missing)
    x, u, deployed = WORLD.logs(12, [*[POLICIES[0]] * 14, POLICIES[1]], 3, 15)
    result = reaction_of(pc.Logs(x, u, deployed))
    assert any("policy 1: 3 episodes are few" in text for text in result.missing)


def test_next_policy_prefers_what_was_not_tried() -> None:
    tried = [POLICIES[0], POLICIES[1]]  # along the first axis
    logs = pc.Logs(*WORLD.logs(13, tried, 20, 15))
    candidates = np.stack([POLICIES[0], POLICIES[1], [[[0.0, 0.5]]], [[[0.25, 0.0]]]])
    assert np.array_equal(reaction_of(logs, candidates=candidates).next_policy, candidates[2])
    free = reaction_of(logs, radius=0.3).next_policy - logs.policies[-1]
    assert np.linalg.norm(free) == pytest.approx(0.3) and abs(free[0, 0, 1]) > 0.2


def test_next_policy_moves_an_input_that_stood_still() -> None:
    x, u, deployed = WORLD.logs(14, POLICIES[:1], 40, 15)
    logs = pc.Logs(x, u, deployed)
    assert np.linalg.norm(reaction_of(logs).next_policy) > 0.1
    assert np.array_equal(reaction_of(logs, candidates=np.stack([POLICIES[0], POLICIES[3]])).next_policy, POLICIES[3])


WRONG = {
    "no logs": (lambda: reaction_of([1.0]), "logs", "pc.Logs"),
    "gain transposed": (lambda: reaction_of(gain=WORLD.K.T), "gain", "swapped"),
    "gain of the other sign": (lambda: reaction_of(gain=-WORLD.K), "gain", "Pass -gain"),
    "no key": (lambda: reaction_of(key=None), "key", "random key"),
    "no permutations": (lambda: reaction_of(permutations=0), "permutations", "at least 1"),
    "half a permutation": (lambda: reaction_of(permutations=9.5), "permutations", "at least 1"),
    "memory below the lags deployed": (
        lambda: reaction_of(pc.Logs(*WORLD.logs(0, [np.full((2, 1, 2), 0.1)], 2, 10)), memory=1),
        "memory",
        "at least 2",
    ),
    "one candidate without its axis": (lambda: reaction_of(candidates=POLICIES[0]), "candidates", "[M]"),
    "no candidates": (lambda: reaction_of(candidates=np.zeros((0, 1, 1, 2))), "candidates", "(1, 1, 2)"),
    "candidates that are not finite": (
        lambda: reaction_of(candidates=np.full((1, 1, 1, 2), np.nan)),
        "candidates",
        "finite",
    ),
    "a negative radius": (lambda: reaction_of(radius=-1.0), "radius", "positive"),
    "a radius that is no number": (lambda: reaction_of(radius="wide"), "radius", "positive"),
    "directions without their axis": (lambda: reaction_of(directions=np.eye(2)), "directions", "[D]"),
    "directions on state and input": (lambda: reaction_of(directions=np.ones((1, 2, 3))), "directions", "state alone"),
}


@pytest.mark.parametrize("case", WRONG)
def test_test_reaction_refuses_with_one_clear_message(case: str) -> None:
    build, name, *words = WRONG[case]
    assert_refused(build, name, *words)
