"""What the logs leave open: said in words, with infinite standard errors, and nothing else."""

import jax
import numpy as np

import perfcontrol as pc
from perfcontrol.identification.blocks import hidden_directions, pseudo_inverse
from tests.identification.worlds import small_policies, small_world
from tests.tools import assert_close

WORLD = small_world()
LOGS = pc.Logs(*WORLD.logs(1, small_policies(), 12, 25))
CONSTANT = {"gain": WORLD.K, "reaction": "constant"}
COST = pc.QuadraticCost(np.eye(2), np.eye(1))


def entry(i: int, j: int, n: int = 2) -> np.ndarray:
    out = np.zeros((n, n))
    out[i, j] = 1.0
    return out


def test_pseudo_inverse_solves_in_columns_of_any_size() -> None:
    r = np.random.default_rng(0)
    scale = np.array([1e-6, 1.0, 1e5, 1.0])
    root = r.standard_normal((4, 3))
    singular, full = root @ root.T, root @ root.T + np.eye(4)
    found = pseudo_inverse(np.stack([part * scale * scale[:, None] for part in (singular, full)]))
    assert_close(found[1] * scale * scale[:, None], np.linalg.inv(full), 1e-8)
    inner = found[0] * scale * scale[:, None]
    assert_close(singular @ inner @ singular, singular, 1e-8)


def test_hidden_directions_span_the_null_space_each_with_few_parts() -> None:
    scale = np.array([1e-6, 1.0, 1e5, 1.0, 3.0, 1.0])
    root = np.zeros((6, 3))
    root[0, 0] = root[1, 0] = root[2, 1] = root[3, 1] = root[4, 2] = 1.0  # pairs (0, 1), (2, 3); 5 is never seen
    hidden = hidden_directions(root @ root.T * scale * scale[:, None]) * scale[:, None]
    hidden /= np.abs(hidden).max(axis=0)
    places = sorted(tuple(np.flatnonzero(np.abs(column) > 1e-6).tolist()) for column in hidden.T)
    assert places == [(0, 1), (2, 3), (5,)]
    assert np.abs(root.T @ hidden).max() < 1e-9
    assert hidden_directions(np.diag(scale)).shape == (6, 0)


def test_two_directions_of_the_same_squares_are_named_and_leave_costs_as_they_are() -> None:
    once = pc.fit(LOGS, directions=WORLD.directions, **CONSTANT)
    twice = pc.fit(LOGS, directions=np.concatenate([WORLD.directions, -WORLD.directions]), **CONSTANT)
    assert once.unidentified == () and np.isfinite(once.scale.standard_error).all()
    assert len(twice.unidentified) == 1 and "between direction 1 and direction 2" in twice.unidentified[0]
    assert np.isinf(twice.scale.standard_error).all() and np.isinf(twice.deployed_scale.standard_error).all()
    assert np.isfinite(twice.noise_covariance.standard_error).all()
    assert_close(np.sum(np.asarray(twice.scale.mean) ** 2), float(once.scale.mean[0, 0]) ** 2, 1e-4)
    M, key = small_policies()[3], jax.random.key(0)
    single = [float(pc.expected_cost(fit.problem(cost=COST, horizon=9), M)) for fit in (once, twice)]
    np.testing.assert_allclose(*single, rtol=1e-3)
    stacks = [fit.ensemble(5, key=key, cost=COST, horizon=9) for fit in (once, twice)]
    np.testing.assert_allclose(*[jax.vmap(lambda p: pc.expected_cost(p, M))(stack) for stack in stacks], rtol=1e-3)


def test_directions_of_dependent_squares_are_named_and_no_others() -> None:
    plus, minus = entry(0, 0) + entry(0, 1), entry(0, 0) - entry(0, 1)  # squares add up to twice those of two entries
    directions = np.stack([entry(0, 0), entry(1, 0), entry(0, 1), entry(1, 1), plus, minus])
    fit = pc.fit(LOGS, directions=directions, **CONSTANT)
    assert np.isinf(np.asarray(fit.scale.standard_error)[:, 0]).tolist() == [True, False, True, False, True, True]
    assert "direction 1, direction 3, direction 5 and direction 6" in fit.unidentified[0]


def test_a_direction_that_acts_on_a_constant_looks_like_noise() -> None:
    x, u, deployed = WORLD.logs(6, small_policies(), 12, 20)
    still = np.concatenate([x, np.full((*x.shape[:2], 1), 2.0)], axis=2)
    logs = pc.Logs(still, u, np.concatenate([deployed, np.zeros((60, 1, 1, 1))], axis=3))
    gain = np.array([[0.2, 0.1, 0.0]])
    fit = pc.fit(logs, gain, directions=np.stack([entry(0, 0, 3), entry(0, 2, 3)]), reaction="constant")
    assert any("between the noise and direction 2" in text for text in fit.unidentified)
    assert np.isinf(np.asarray(fit.scale.standard_error)[:, 0]).tolist() == [False, True]
    assert np.isinf(fit.noise_covariance.standard_error).sum() == 1
    assert np.isinf(fit.noise_covariance.standard_error[0, 0])
    assert np.all(np.asarray(fit.noise_covariance.standard_error)[:2, :2] > 1e-3)  # though the third has no noise


def test_a_direction_on_what_never_moved_from_zero_is_named() -> None:
    x, u, deployed = WORLD.logs(7, small_policies(), 12, 20)
    flat = np.concatenate([x, np.zeros((*x.shape[:2], 1))], axis=2)
    logs = pc.Logs(flat, u, np.concatenate([deployed, np.zeros((60, 1, 1, 1))], axis=3))
    fit = pc.fit(logs, np.array([[0.2, 0.1, 0.0]]), directions=[entry(0, 0, 3), entry(1, 2, 3)], reaction="constant")
    assert any("the scale along direction 2: the states never moved" in text for text in fit.unidentified)
    assert np.isinf(np.asarray(fit.scale.standard_error)[:, 0]).tolist() == [False, True]


def test_a_scale_of_zero_is_no_gap() -> None:
    calm = WORLD.but(scale=lambda M: np.array([0.0]))
    fit = pc.fit(pc.Logs(*calm.logs(2, small_policies(), 12, 25)), directions=WORLD.directions, **CONSTANT)
    assert fit.unidentified == () and abs(float(fit.scale.mean[0, 0])) < 0.1
