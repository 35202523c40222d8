"""Estimated directions against dense products, the Gaussian likelihood by finite differences, and known worlds."""

import jax
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.identification.directions import canonical, product_map
from perfcontrol.identification.joint import joint_scoring
from perfcontrol.identification.moments import upper
from tests.identification.worlds import small_policies, small_world
from tests.tools import assert_close, assert_refused, central_differences

WORLD = small_world()
LOGS = pc.Logs(*WORLD.logs(11, small_policies(), 30, 30))
TWO = np.array([[[0.8, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.4, 0.7]]])


def fitted(logs: pc.Logs = LOGS, reaction: object = "constant", **options) -> pc.Fit:
    return pc.fit(logs, WORLD.K, reaction={"mean": "constant", "scale": reaction}, **options)


def second_moments(fit: pc.Fit, deployment: int) -> np.ndarray:
    """Σ_k σ_k² D_k ⊗ D_k, made symmetric in what acts on x xᵀ, which alone can be seen: (i, j, a, b)."""
    D, scale = np.asarray(fit.directions.mean), np.asarray(fit.deployed_scale.mean)[deployment]
    return symmetrised(D * scale[:, None, None])


def symmetrised(D: np.ndarray) -> np.ndarray:
    whole = np.einsum("kia,kjb->ijab", D, D)
    return (whole + np.swapaxes(whole, 2, 3)) / 2


def test_product_map_gives_the_coefficients_of_the_dense_product() -> None:
    r = np.random.default_rng(0)
    D, z = r.standard_normal((3, 2)), r.standard_normal(2)
    coefficients = np.einsum("rcuv,u,v->rc", product_map(3, 2), D.ravel(), D.ravel())
    assert_close(coefficients @ np.array([z[0] ** 2, z[0] * z[1], z[1] ** 2]), upper(np.outer(D @ z, D @ z)), 1e-12)


def test_one_direction_is_found_with_its_scale_within_five_standard_errors() -> None:
    fit = fitted(reaction="norm")
    D = canonical(WORLD.directions) / np.linalg.norm(WORLD.directions)
    assert fit.directions.mean.shape == (1, 2, 2)
    assert np.all(np.abs(np.asarray(fit.directions.mean) - D) <= 5 * np.asarray(fit.directions.standard_error))
    assert np.all(np.asarray(fit.directions.standard_error) < 0.1)
    truth = np.array([WORLD.scale(M)[0] for M in small_policies()]) * np.linalg.norm(WORLD.directions)
    scale = fit.deployed_scale
    assert np.all(np.abs(np.abs(scale.mean[:, 0]) - truth) <= 5 * np.asarray(scale.standard_error[:, 0]))


def test_noise_scale_and_direction_maximise_the_gaussian_likelihood_together() -> None:
    fit = fitted(rank=1)
    x = np.concatenate([x[:-1] for x in LOGS.x])
    u, y = np.concatenate(LOGS.u), np.concatenate([x[1:] for x in LOGS.x])
    A, B, c = (np.asarray(e.mean) for e in (fit.A, fit.B, fit.noise_mean))
    residual = (y - x @ A.T - u @ B.T - c) * np.sqrt(len(x) / (len(x) - 4))

    def likelihood(p: np.ndarray) -> float:
        image = x @ p[3:].reshape(2, 2).T
        V = np.array([[p[0], p[1]], [p[1], p[2]]]) + image[:, :, None] * image[:, None, :]
        squares = np.einsum("ti,ti->", residual, np.linalg.solve(V, residual[..., None])[..., 0])
        return -(squares + np.linalg.slogdet(V)[1].sum()) / 2

    scaled = float(fit.scale.mean[0, 0]) * np.asarray(fit.directions.mean[0])
    p = np.concatenate([upper(np.asarray(fit.noise_covariance.mean)), scaled.ravel()])
    gradient, elsewhere = (central_differences(likelihood, q, 1e-4) for q in (p, 1.02 * p))
    assert np.abs(gradient).max() < 0.05 < 1e-2 * np.abs(elsewhere).max()


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_rank_is_chosen_as_the_world_has_it(rank: int) -> None:
    world = WORLD.but(directions=TWO[:rank], scale=lambda M: np.array([0.6, 0.5])[:rank])
    fit = fitted(pc.Logs(*world.logs(12, small_policies(), 40, 30)), key=jax.random.key(1))
    assert len(fit.directions.mean) == rank


def test_two_directions_give_the_second_moments_of_the_world() -> None:
    world = WORLD.but(directions=TWO, scale=lambda M: np.array([0.6, 0.5]))
    fit = fitted(pc.Logs(*world.logs(13, small_policies(), 100, 40)), rank=2)
    truth = symmetrised(TWO * np.array([0.6, 0.5])[:, None, None])
    assert np.abs(second_moments(fit, 0) - truth).max() < 0.03  # of 0.23
    assert any("beyond their second moments" in text for text in fit.unidentified)


def test_fitted_cost_does_not_depend_on_whether_directions_were_given_or_found() -> None:
    cost = pc.QuadraticCost(np.eye(2), 0.1 * np.eye(1))
    given = pc.fit(LOGS, WORLD.K, directions=WORLD.directions, reaction={"mean": "constant", "scale": "norm"})
    M = small_policies()[3]
    costs = [float(pc.expected_cost(fit.problem(cost=cost, horizon=15), M)) for fit in (given, fitted(reaction="norm"))]
    assert abs(costs[0] / costs[1] - 1) < 0.01


def test_rank_is_refused_unless_it_is_a_count() -> None:
    for rank in (-1, 1.5, "two"):
        assert_refused(lambda rank=rank: fitted(rank=rank), "rank", "at least 0")


@pytest.mark.parametrize(("angle", "share"), [(1.2, 1.0), (2.2, 0.3), (1.55, 3.0)])
def test_scoring_reaches_the_same_fit_from_directions_far_off(angle: float, share: float) -> None:
    fit = fitted(rank=1, reaction="norm")
    data, spread = fit.data, fit.estimated.spread
    residual, features = fit.estimated.location.residual(data), fit.scale_features.values(data.policies)
    aside = np.array([[[0.0, 1.0], [-0.6, 0.5]]])
    aside -= np.sum(aside * spread.directions) * spread.directions
    start = np.cos(angle) * spread.directions + np.sin(angle) * aside / np.linalg.norm(aside)
    near, far = (
        joint_scoring(data, residual, features, (spread.noise, scales, D), True)
        for scales, D in ((spread.scales, spread.directions), (share * spread.scales, start))
    )
    assert_close(far.noise, near.noise, 1e-3)
    assert_close(far.scales**2, near.scales**2, 1e-3)
    assert_close(symmetrised(far.directions), symmetrised(near.directions), 1e-3)
