"""The fit against plain NumPy regressions, likelihoods by finite differences, and worlds that are known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import perfcontrol as pc
from perfcontrol.identification.parameter import parameter
from tests.identification.worlds import small_policies, small_world
from tests.tools import assert_close, assert_refused, central_differences

WORLD = small_world()
LOGS = pc.Logs(*WORLD.logs(1, small_policies(), 12, 25))
COST = pc.QuadraticCost(np.eye(2), 0.1 * np.eye(1))


def fitted(logs: pc.Logs = LOGS, **options) -> pc.Fit:
    return pc.fit(logs, WORLD.K, directions=WORLD.directions, **({"reaction": "constant"} | options))


def rows(logs: pc.Logs) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """x, u, y, episode and ‖M‖ of every transition."""
    counts = [len(x) - 1 for x in logs.x]
    norms = np.array([np.linalg.norm(M) for M in logs.deployed])
    return (
        np.concatenate([x[:-1] for x in logs.x]),
        np.concatenate([u[:count] for u, count in zip(logs.u, counts, strict=True)]),
        np.concatenate([x[1:] for x in logs.x]),
        np.repeat(np.arange(len(logs)), counts),
        np.repeat(norms, counts),
    )


def conditional_covariances(noise: np.ndarray, scale: np.ndarray, logs: pc.Logs) -> np.ndarray:
    x, _, _, _, norms = rows(logs)
    sizes = scale[0] + scale[1] * norms if len(scale) == 2 else np.full(len(x), scale[0])
    return np.stack(
        [
            noise + s**2 * np.outer(WORLD.directions[0] @ z, WORLD.directions[0] @ z)
            for s, z in zip(sizes, x, strict=True)
        ]
    )


def test_fit_of_the_mean_matches_a_dense_weighted_regression() -> None:
    fit = fitted(reaction={"mean": "constant", "scale": "norm"})
    x, u, y, _, _ = rows(LOGS)
    V = conditional_covariances(np.asarray(fit.noise_covariance.mean), np.asarray(fit.scale.mean)[0], LOGS)
    design, target = [], []
    for V_t, x_t, u_t, y_t in zip(V, x, u, y, strict=True):
        root = np.linalg.inv(np.linalg.cholesky(V_t))
        design.append(root @ np.kron(np.concatenate([x_t, u_t, [1.0]]), np.eye(2)))
        target.append(root @ y_t)
    beta = np.linalg.lstsq(np.concatenate(design), np.concatenate(target))[0].reshape(4, 2).T
    assert_close(fit.A.mean, beta[:, :2], 1e-6)
    assert_close(fit.B.mean, beta[:, 2:3], 1e-6)
    assert_close(fit.noise_mean.mean, beta[:, 3], 1e-6)


@pytest.mark.parametrize("reaction", ["constant", "norm"])
def test_fit_of_the_covariance_maximises_the_gaussian_likelihood(reaction: str) -> None:
    fit = fitted(reaction={"mean": "constant", "scale": reaction})
    x, u, y, _, _ = rows(LOGS)
    A, B, c = (np.asarray(e.mean) for e in (fit.A, fit.B, fit.noise_mean))
    residual = (y - x @ A.T - u @ B.T - c) * np.sqrt(len(x) / (len(x) - 4))

    def likelihood(p: np.ndarray) -> float:
        V = conditional_covariances(np.array([[p[0], p[1]], [p[1], p[2]]]), p[3:], LOGS)
        squares = np.einsum("ti,ti->", residual, np.linalg.solve(V, residual[..., None])[..., 0])
        return -(squares + np.linalg.slogdet(V)[1].sum()) / 2

    noise, scale = np.asarray(fit.noise_covariance.mean), np.asarray(fit.scale.mean)[0]
    p = np.array([noise[0, 0], noise[0, 1], noise[1, 1], *scale])
    gradient = central_differences(likelihood, p, 1e-4)
    elsewhere = central_differences(likelihood, p * 1.02, 1e-4)
    assert np.abs(gradient).max() < 1e-2 < 1e-2 * np.abs(elsewhere).max()


def test_standard_errors_match_estimates_with_each_episode_left_out() -> None:
    fit = fitted()
    x, u, y, episode, _ = rows(LOGS)
    V = conditional_covariances(np.asarray(fit.noise_covariance.mean), np.asarray(fit.scale.mean)[0], LOGS)
    roots = np.linalg.cholesky(V)
    design = np.stack([np.kron(np.eye(2), np.concatenate([*z, [1.0]])) for z in zip(x, u, strict=True)])  # (N, 2, 8)
    design, target = np.linalg.solve(roots, design), np.linalg.solve(roots, y[..., None])[..., 0]
    without = [
        np.linalg.lstsq(design[episode != e].reshape(-1, 8), target[episode != e].ravel())[0] for e in range(len(LOGS))
    ]
    count, spread = len(LOGS), np.std(without, axis=0).reshape(2, 4)
    errors = spread * np.sqrt(count - 1)
    assert_close(fit.A.standard_error, errors[:, :2], 1e-5)
    assert_close(fit.B.standard_error, errors[:, 2:3], 1e-5)


def test_degrees_of_freedom_are_those_of_a_sample_of_gaussians_and_fewer_for_heavy_tails() -> None:
    r = np.random.default_rng(0)
    gaussian, heavy = r.standard_normal((5000, 4)), r.standard_t(5, (5000, 4))
    few, many = parameter(np.zeros(4), heavy), parameter(np.zeros(4), gaussian)
    assert np.all(np.abs(np.asarray(many.degrees_of_freedom) / 5000 - 1) < 0.15)
    assert np.all(np.asarray(few.degrees_of_freedom) < 0.6 * np.asarray(many.degrees_of_freedom))
    for found, data in ((few, heavy), (many, gaussian)):
        assert_close(found.standard_error, np.sqrt(np.sum(data**2, axis=0) * 4999 / 5000), 1e-9)


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_intervals_are_those_of_the_t_law(level: float) -> None:
    influence = np.random.default_rng(1).standard_normal((12, 3))
    found = parameter(np.arange(3.0), influence - influence.mean(axis=0))
    low, high = found.interval(level)
    degrees = np.asarray(found.degrees_of_freedom)
    expected = stats.t.interval(level, degrees, loc=np.arange(3.0), scale=np.asarray(found.standard_error))
    assert_close(low, expected[0], 1e-9)
    assert_close(high, expected[1], 1e-9)


def test_fit_recovers_the_world_within_five_standard_errors() -> None:
    logs = pc.Logs(*WORLD.but(noise_mean=np.array([0.3, -0.2])).logs(2, small_policies(), 60, 40))
    fit = fitted(logs, reaction="auto")
    assert fit.mean_features.name == "constant" and fit.scale_features.name == "norm"
    truth = {"A": WORLD.A, "B": WORLD.B, "noise_mean": [0.3, -0.2], "noise_covariance": WORLD.noise}
    for name, value in {**truth, "scale": [[0.2, 0.4]]}.items():
        estimate = getattr(fit, name)
        gap = np.abs(np.asarray(estimate.mean) - value)
        assert np.all(gap <= 5 * np.asarray(estimate.standard_error)), name
        assert np.all(np.asarray(estimate.standard_error) < 0.1), name
    assert fit.unidentified == ()


@pytest.mark.parametrize(
    ("name", "scale"),
    [
        ("constant", lambda M: np.array([0.4])),
        ("squared norm", lambda M: np.array([0.2 + 0.8 * np.sum(M**2)])),
        ("affine", lambda M: np.array([0.5 + 0.4 * M[0, 0, 0] - 0.5 * M[0, 0, 1]])),
    ],
)
def test_auto_finds_what_the_scale_follows(name: str, scale) -> None:
    logs = pc.Logs(*WORLD.but(scale=scale).logs(3, small_policies(), 40, 40))
    assert fitted(logs, reaction={"mean": "constant", "scale": "auto"}).scale_features.name == name


def test_affine_reaction_of_mean_and_scale_is_recovered_with_its_gain() -> None:
    slope = np.array([[[0.2, -0.1], [0.0, 0.1]], [[-0.1, 0.2], [0.1, 0.0]]])  # (n, n, 2): by the entries of M
    world = WORLD.but(mean=lambda M: slope @ M[0, 0], scale=lambda M: np.array([0.4 + M[0, 0] @ [0.2, -0.1]]))
    fit = pc.fit(pc.Logs(*world.logs(4, small_policies(), 60, 40)), WORLD.K, directions=WORLD.directions)
    assert (fit.mean_features.name, fit.scale_features.name) == ("affine", "affine")
    problem = fit.problem(cost=COST, horizon=10)
    for M in small_policies():
        found = np.asarray(problem.perturbation.mean(jnp.asarray(M), 10))[0]
        assert np.abs(found - slope @ M[0, 0]).max() < 0.1
        scale = float(problem.perturbation.scales(jnp.asarray(M), 10)[0, 0])
        assert abs(abs(scale) - world.scale(M)[0]) < 0.1
    assert np.abs(np.asarray(problem.perturbation.mean(jnp.zeros((1, 1, 2)), 10))).max() < 1e-12


def test_auto_finds_a_reaction_to_as_many_directions_of_the_policy_as_there_are_deployments() -> None:
    axis, part = np.array([0.5, -0.5, 0.5, 0.5]).reshape(2, 1, 2), np.array([[0.3, 0.0], [-0.2, 0.4]])
    policies = [np.zeros((2, 1, 2)), *0.6 * np.eye(4).reshape(4, 2, 1, 2)]
    world = WORLD.but(mean=lambda M: part * np.sum(M * axis), scale=lambda M: np.array([0.3]))
    fit = fitted(pc.Logs(*world.logs(8, policies, 60, 30)), reaction="auto")
    assert (fit.mean_features.name, fit.scale_features.name) == ("affine", "constant")


def test_auto_takes_deployments_of_one_episode_each() -> None:
    r = np.random.default_rng(11)
    logs = pc.Logs(*WORLD.logs(11, [0.5 * r.standard_normal((1, 1, 2)) for _ in range(60)], 1, 40))
    fit = fitted(logs, reaction="auto")
    assert fit.mean_features.name == "constant" and fit.scale_features.name in ("norm", "squared norm")


@pytest.mark.parametrize("seed", [1, 3, 8])  # 3: rough squares say that the noise has no variance along one direction
def test_noise_that_is_nearly_singular_does_not_lead_the_fit_astray(seed: int) -> None:
    along = np.array([0.55, 0.44])
    world = WORLD.but(noise=np.outer(along, along) + 3e-4 * np.eye(2))
    fit = fitted(pc.Logs(*world.logs(seed, small_policies(), 10, 15)), reaction={"mean": "constant", "scale": "norm"})
    assert np.abs(np.asarray(fit.scale.mean) - [[0.2, 0.4]]).max() < 0.1
    smallest = np.linalg.eigvalsh(np.asarray(fit.noise_covariance.mean))[0]
    assert 2e-4 < smallest < 4e-4


def test_own_features_give_the_fit_of_the_feature_that_they_equal() -> None:
    own = fitted(reaction=lambda M: jnp.sum(M**2)[None])
    known = fitted(reaction="squared norm")
    assert_close(own.scale.mean, known.scale.mean, 1e-9)
    assert_close(own.mean_reaction.mean, known.mean_reaction.mean, 1e-9)


def test_fit_says_what_feedback_alone_does_not_identify() -> None:
    logs = pc.Logs(*WORLD.logs(5, small_policies()[:1], 60, 30))
    fit = fitted(logs)
    assert "B along the input direction [1]" in fit.unidentified[0]
    assert any("only one policy" in text for text in fit.unidentified)
    assert np.all(np.isinf(fit.B.standard_error)) and np.all(np.isinf(fit.A.standard_error))
    closed = np.asarray(fit.A.mean) - np.asarray(fit.B.mean) @ WORLD.K
    assert np.abs(closed - (WORLD.A - WORLD.B @ WORLD.K)).max() < 0.1
    assert_refused(lambda: fit.problem(cost=COST, horizon=10), "logs", "B along the input direction")


def test_a_state_that_stands_still_leaves_its_column_of_A_open() -> None:
    x, u, deployed = WORLD.logs(6, small_policies(), 12, 20)
    still = np.concatenate([x, np.full((*x.shape[:2], 1), 2.0)], axis=2)
    logs = pc.Logs(still, u, np.concatenate([deployed, np.zeros((60, 1, 1, 1))], axis=3))
    fit = pc.fit(logs, np.array([[0.2, 0.1, 0.0]]), directions=np.eye(3)[None], reaction="constant")
    assert "A along the state direction [0, 0, 1]" in fit.unidentified[0]
    assert np.isinf(np.asarray(fit.A.standard_error)[:, 2]).all()
    assert np.isfinite(np.asarray(fit.A.standard_error)[:, :2]).all() and np.isfinite(fit.B.standard_error).all()


def test_one_long_episode_is_cut_into_blocks_for_its_standard_errors() -> None:
    x, u, deployed = WORLD.logs(7, small_policies()[1:2], 1, 4000)
    fit = fitted(pc.Logs(x, u, deployed))
    gap = np.abs(np.asarray(fit.A.mean) - WORLD.A)
    assert np.all(gap < 5 * np.asarray(fit.A.standard_error)) and np.all(np.asarray(fit.A.standard_error) < 0.1)


def test_fitted_problem_costs_what_a_problem_of_the_same_numbers_costs() -> None:
    fit = fitted(reaction="norm")
    problem = fit.problem(cost=COST, horizon=10, feasible_set=pc.FrobeniusBall(1.0))
    scale, first = np.asarray(fit.scale.mean)[0], np.stack([x[0] for x in LOGS.x])
    by_hand = pc.PerformativeProblem(
        system=pc.LinearSystem(fit.A.mean, fit.B.mean),
        horizon=10,
        gain=WORLD.K,
        noise=pc.Gaussian(fit.noise_mean.mean, fit.noise_covariance.mean),
        cost=COST,
        perturbation=pc.DirectionalPerturbation(
            WORLD.directions,
            lambda M: (scale[0] + scale[1] * jnp.sqrt(jnp.sum(M**2)))[None],
            lambda M: fit.mean_reaction.mean[0] * jnp.sqrt(jnp.sum(M**2)),
        ),
        initial_state=pc.Gaussian(first.mean(axis=0), np.cov(first, rowvar=False, ddof=0)),
    )
    M = small_policies()[3]
    assert_close(pc.expected_cost(problem, M), pc.expected_cost(by_hand, M), 1e-10)


def test_a_constant_scale_that_came_out_negative_makes_the_same_problem() -> None:
    fit = fitted()
    block = fit.estimated.spread.block
    flipped = replace(block, values=np.where(np.arange(len(block.values)) == 3, -block.values, block.values))
    spread = fit.estimated.spread._replace(block=flipped)
    other = replace(fit, estimated=fit.estimated._replace(spread=spread))
    costs = [float(pc.expected_cost(f.problem(cost=COST, horizon=9), small_policies()[1])) for f in (fit, other)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)


def test_ensemble_is_one_stacked_problem_that_spreads_as_the_standard_errors_say() -> None:
    fit = fitted(reaction={"mean": "constant", "scale": "norm"})
    stack = fit.ensemble(200, key=jax.random.key(0), cost=COST, horizon=10)
    single = fit.problem(cost=COST, horizon=10)
    assert jax.tree.structure(stack) == jax.tree.structure(single)
    for drawn, estimate in ((stack.system.A, fit.A), (stack.system.B, fit.B)):
        ratio = np.asarray(drawn).std(axis=0, ddof=1) / np.asarray(estimate.standard_error)
        assert np.all(np.abs(ratio - 1) < 0.25)
        shift = np.abs(np.asarray(drawn).mean(axis=0) - np.asarray(estimate.mean))
        assert np.all(shift < 0.4 * np.asarray(estimate.standard_error))
    costs = jax.vmap(lambda p: pc.expected_cost(p, small_policies()[1]))(stack)
    one = jax.tree.map(lambda leaf: leaf[7], stack)
    assert_close(costs[7], pc.expected_cost(one, small_policies()[1]), 1e-10)


def test_fit_reads_as_a_paragraph_and_a_table() -> None:
    fit = fitted(reaction="norm")
    assert "1500 transitions of 60 episodes under 5 policies" in str(fit) and "'norm'" in str(fit)
    dataset = fit.table()
    assert dataset["A"].sel(value="estimate").shape == (2, 2)
    for name in ("A", "B", "noise_mean", "noise_covariance", "mean_reaction", "scale", "deployed_scale"):
        values = dataset[name]
        width = values.sel(value="high") - values.sel(value="low")
        low, high = getattr(fit, name).interval()
        np.testing.assert_allclose(width, high - low, rtol=1e-6)
        assert np.all(width >= 2 * 1.9599 * values.sel(value="standard_error"))


WRONG = {
    "no logs": (lambda: pc.fit([1.0], directions=np.eye(2)[None]), "logs", "pc.Logs"),
    "gain transposed": (lambda: fitted_with(gain=WORLD.K.T), "gain", "swapped"),
    "gain as a number": (lambda: fitted_with(gain=0.3), "gain", "(1, 2)"),
    "gain of the other sign": (lambda: fitted_with(gain=-WORLD.K), "gain", "Pass -gain"),
    "gain that is not finite": (lambda: fitted_with(gain=[[np.nan, 0.0]]), "gain", "finite"),
    "memory below the lags deployed": (lambda: fitted_with(logs=long_memory(), memory=1), "memory", "at least 2"),
    "memory that is none": (lambda: fitted_with(memory=0), "memory", "at least 1"),
    "one direction without its axis": (lambda: fitted_with(directions=np.eye(2)), "directions", "[D]"),
    "directions of another size": (lambda: fitted_with(directions=np.ones((1, 2, 4))), "directions", "(k, 2, 3)"),
    "direction of zeros": (lambda: fitted_with(directions=np.zeros((1, 2, 2))), "directions", "nonzero"),
    "unknown reaction": (lambda: fitted_with(reaction="cubic"), "reaction", "'cubic'"),
    "unknown part of a reaction": (
        lambda: fitted_with(reaction={"variance": "norm"}),
        "reaction",
        "'mean' and 'scale'",
    ),
    "features that are no vector": (lambda: fitted_with(reaction=lambda M: M), "reaction", "vector"),
    "features that are not finite": (lambda: fitted_with(reaction=lambda M: jnp.log(M[0, 0])), "reaction", "finite"),
    "level in per cent": (lambda: fitted().A.interval(95), "level", "0.95"),
    "no members": (lambda: fitted().ensemble(0, key=jax.random.key(0), cost=COST, horizon=9), "k", "at least 1"),
    "ensemble without a key": (lambda: fitted().ensemble(3, cost=COST, horizon=9), "key", "random key"),
}


def fitted_with(logs: pc.Logs = LOGS, **options) -> pc.Fit:
    return pc.fit(logs, **({"gain": WORLD.K, "directions": WORLD.directions} | options))


def long_memory() -> pc.Logs:
    return pc.Logs(*WORLD.logs(0, [np.full((2, 1, 2), 0.1)], 2, 10))


@pytest.mark.parametrize("case", WRONG)
def test_fit_refuses_with_one_clear_message(case) -> None:
    build, name, *words = WRONG[case]
    assert_refused(build, name, *words)
