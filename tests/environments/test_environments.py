"""The Gymnasium environment: its interface, the plant in it, the exact numbers that it hands out."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import perfcontrol as pc
from tests.online.test_controller import varying
from tests.solvers.problems import performative_prediction
from tests.tools import assert_refused, normal

pc.environments.register()
ID = "perfcontrol/PerformativeLDS-v0"
FIXED = np.array([[0.9, 0.2], [0.0, 0.8]])  # A of the example, whose Δ_t is ± (0.1 + 0.2 ‖M‖) I


@pytest.mark.filterwarnings("ignore:.*Box (action|observation) space|.*Box action spaces")
@pytest.mark.parametrize("actions", ["inputs", "policies"])
def test_environment_passes_the_checks_of_gymnasium(actions):
    env = gymnasium.make(ID, actions=actions)
    check_env(env.unwrapped)
    env.close()


def test_episode_is_the_recursion_of_the_plant_and_rewards_are_its_costs():
    problem = varying()
    env = gymnasium.make(ID, problem=problem, regret=False)
    observation, _ = env.reset(seed=1, options={"deploy": 0.2 * normal(1, *problem.policy_shape)})
    rng, w, total = np.random.default_rng(0), np.zeros((2, 2)), 0.0
    for t in range(5):
        x = observation[:2]
        np.testing.assert_array_equal(observation[2:], w.reshape(-1))
        u = rng.normal(size=2)
        observation, reward, ended, cut, info = env.step(u)
        centred = x - [0.5, 0.0]
        np.testing.assert_allclose(reward, -(centred @ centred + u @ u), rtol=1e-12)
        total += reward
        assert (ended, cut) == (t == 4, False)
        if not ended:
            w = np.stack([observation[2:4], w[0]])
            np.testing.assert_allclose(observation[:2], info["A"] @ np.concatenate([x, u]) + w[0], rtol=1e-12)
    np.testing.assert_array_equal(observation[:2], x)  # the terminal stage moves nothing
    assert "A" not in info and np.isfinite(total)


def test_seed_settles_the_episode_and_another_one_changes_it():
    env = gymnasium.make(ID)
    rows = []
    for seed in (3, 3, 4, None):
        env.reset(seed=seed)
        rows.append(env.step(np.ones(2))[0])
    np.testing.assert_array_equal(rows[0], rows[1])
    assert np.abs(rows[1] - rows[2]).min() > 1e-6 < np.abs(rows[2] - rows[3]).min()


def test_plant_reacts_to_the_policy_deployed_last_until_another_one_is():
    env = gymnasium.make(ID)

    def scale():
        return np.abs(env.step(np.zeros(2))[4]["A"] - FIXED)

    env.reset(seed=0)
    np.testing.assert_allclose(scale(), 0.1 * np.eye(2), atol=1e-12)
    M = np.array([[[0.3, 0.0], [0.4, 0.0]]])
    for options in ({"deploy": M}, None, {}):  # deployed, and still deployed
        env.reset(options=options)
        np.testing.assert_allclose(scale(), 0.2 * np.eye(2), atol=1e-12)
        np.testing.assert_array_equal(env.unwrapped.deployed, M)
    env.reset(options={"deploy": 2 * M})
    np.testing.assert_allclose(scale(), 0.3 * np.eye(2), atol=1e-12)


def test_mean_return_of_the_deployed_policy_is_minus_its_exact_cost():
    count = 4000
    envs = gymnasium.make_vec(ID, num_envs=count)
    M = np.array([[[-0.5, -0.1], [0.1, -0.4]]])
    observations, info = envs.reset(seed=0, options={"deploy": M})
    returns, ended = np.zeros(count), np.zeros(count, bool)
    while not ended.any():
        observations, rewards, ended, _, _ = envs.step(observations[:, 2:] @ M[0].T)
        returns += rewards
    error = returns.std() / np.sqrt(count)
    exact = float(pc.expected_cost(envs.unwrapped.problem, M))
    assert error < 0.03 * exact and abs(returns.mean() + exact) < 5 * error
    np.testing.assert_allclose(info["cost"], exact, rtol=1e-12)


def test_regrets_are_those_of_the_closed_form():
    # C(M; M) = ½ E (z - M)² with z of mean 10 + M/2 and deviation 0.1: M = 20 is stable and optimal
    problem = performative_prediction(0.5)
    env = gymnasium.make(ID, problem=problem)
    for M in (0.0, 12.0, 20.0):
        _, info = env.reset(options={"deploy": [[[M]]]})
        regret = (10 - M / 2) ** 2 / 2
        np.testing.assert_allclose(info["cost"], regret + 0.005, rtol=1e-10)
        for name in ("regret_to_stable", "regret_to_optimal"):
            np.testing.assert_allclose(info[name], regret, rtol=1e-9, atol=1e-9)
    assert env.step([0.0])[4]["regret_to_stable"] == info["regret_to_stable"]


def test_copies_react_each_to_its_own_policy_and_begin_anew_in_the_step_after_the_last():
    envs = gymnasium.make_vec(ID, num_envs=3)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    M = np.arange(3)[:, None, None, None] * np.ones((1, 2, 2)) / 4
    first, info = envs.reset(seed=0, options={"deploy": M})
    costs = [float(pc.expected_cost(envs.unwrapped.problem, policy)) for policy in M]
    np.testing.assert_allclose(info["cost"], costs, rtol=1e-12)
    for t in range(21):
        observations, rewards, ended, cut, info = envs.step(np.ones((3, 2)))
        if t == 0:
            np.testing.assert_allclose(np.abs(info["A"][:, 0, 0] - 0.9), [0.1, 0.2, 0.3], atol=1e-12)
            assert len(np.unique(observations[:, 2])) == 3
        assert ended.tolist() == 3 * [t == 20] and not cut.any()
    assert np.abs(observations).min() > 0 and (rewards < 0).all()
    observations, rewards, ended, _, info = envs.step(np.ones((3, 2)))
    np.testing.assert_array_equal(observations, first)
    assert not rewards.any() and not ended.any() and "A" not in info
    np.testing.assert_array_equal(envs.unwrapped.deployed, M)
    assert (envs.step(np.ones((3, 2)))[1] == -0.2).all()  # x_0 = 0, u = 1
    envs.close()


def test_actions_that_are_policies_are_deployed_and_cost_what_a_path_costs():
    count = 3000
    base = gymnasium.make(ID).unwrapped.problem
    problem = pc.PerformativeProblem(
        system=base.system, horizon=6, noise=base.noise, cost=base.cost, perturbation=base.perturbation,
        feasible_set=pc.FrobeniusBall(1.0),
    )  # fmt: skip
    envs = gymnasium.make_vec(ID, num_envs=count, problem=problem, actions="policies", regret=False)
    observations, _ = envs.reset(seed=0)
    assert observations.shape == (count, 1, 2, 2) and not observations.any()
    M = -2.0 * np.eye(2)[None]
    observations, rewards, ended, _, _ = envs.step(np.repeat(M[None], count, axis=0))
    inside = M / np.linalg.norm(M)
    np.testing.assert_allclose(observations, np.repeat(inside[None], count, axis=0), rtol=1e-12)
    exact = float(pc.expected_cost(problem, inside))
    assert abs(rewards.mean() + exact) < 5 * rewards.std() / np.sqrt(count) < 0.1 * exact
    assert not ended.any() and not envs.reset()[0].any()


def test_controller_runs_on_the_environment():
    env = gymnasium.make(ID, regret=False)
    problem = env.unwrapped.problem
    controller = pc.online.Controller(problem, pc.RSGD(5, 1e-3), gate=False)
    state = controller.init()
    observation, info = env.reset(seed=2)
    assert info == {}
    for t in range(problem.horizon):
        x, u = observation[:2], controller.act(state, observation[:2])
        observation, _, _, _, info = env.step(u)
        state = controller.observe(state, x, u, observation[:2], info["A"])
        np.testing.assert_allclose(state.progress.episodes.w[0, t], observation[2:], rtol=1e-9, atol=1e-12)
    state = controller.end_episode(state)
    env.reset(options={"deploy": state.deployed})
    np.testing.assert_array_equal(env.unwrapped.deployed, state.deployed)


def test_exact_costs_are_left_out_or_refused_where_they_are_not_known():
    base = varying()
    convex = pc.PerformativeProblem(
        system=base.system, horizon=4, noise=base.noise, cost=pc.ConvexCost(lambda t, x, u: t + abs(x[0]) + u @ u)
    )
    assert_refused(lambda: pc.environments.PerformativeLDS(convex), "regret", "not quadratic", "regret=False")
    env = gymnasium.make(ID, problem=convex, regret=False)
    observation, info = env.reset(seed=0)
    assert info == {}
    for t in range(3):
        x = observation[0]
        observation, reward, _, _, info = env.step([0.5, 0.0])
        np.testing.assert_allclose(reward, -(t + abs(x) + 0.25), rtol=1e-12)
        assert set(info) == {"A"}


def test_wrong_deployments_are_refused_and_change_nothing():
    base = varying()
    problem = pc.PerformativeProblem(
        system=base.system, horizon=4, noise=base.noise, cost=base.cost, feasible_set=pc.FrobeniusBall(1.0)
    )
    env = pc.environments.PerformativeLDS(problem, regret=False)
    env.reset(options={"deploy": 0.1 * np.ones((1, 2, 2))})
    for deploy, word in (
        (np.ones((2, 2)), "(2, 2)"),
        (np.full((1, 2, 2), np.nan), "nan"),
        (np.ones((1, 2, 2)), "project"),
        ("best", "str"),
    ):
        assert_refused(lambda deploy=deploy: env.reset(options={"deploy": deploy}), "deploy", word)
        np.testing.assert_array_equal(env.deployed, 0.1)
    assert_refused(lambda: env.reset(options={"deployed": env.deployed}), "options", "'deployed'")


def test_gymnasium_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ImportError, match=r"perfcontrol\[interop\]"):
        pc.environments.register()


def reinforce(envs, rounds, rate, spread, seed=0):
    """Mean policy after plain REINFORCE: inputs drawn about it, returns to come against their mean over the copies."""
    rng = np.random.default_rng(seed)
    M = np.zeros((1, 2, 2))
    envs.reset(seed=seed)
    for _ in range(rounds):
        observations, _ = envs.reset(options={"deploy": M})
        scores, rewards, ended = [], [], np.zeros(1, bool)
        while not ended.any():
            w = observations[:, 2:]
            step = spread * rng.normal(size=w.shape)
            scores.append(step[:, :, None] * w[:, None, :] / spread**2)
            observations, reward, ended, _, _ = envs.step(w @ M[0].T + step)
            rewards.append(reward)
        to_come = np.cumsum(np.array(rewards)[::-1], axis=0)[::-1]
        advantage = to_come - to_come.mean(axis=1, keepdims=True)
        M = M + rate * np.einsum("te,teij->ij", advantage, np.array(scores))[None] / envs.num_envs
    return M


@pytest.mark.slow
def test_plain_reinforce_comes_near_the_stable_policy():
    envs = gymnasium.make_vec(ID, num_envs=512)
    begun = envs.reset()[1]
    M = reinforce(envs, 150, 3e-4, 0.5)
    after = envs.reset(options={"deploy": M})[1]
    assert abs(after["regret_to_stable"][0]) < 0.05 * begun["regret_to_stable"][0]
    assert 0 < after["regret_to_optimal"][0] < 0.1 * begun["regret_to_optimal"][0]
