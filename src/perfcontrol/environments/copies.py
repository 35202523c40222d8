"""Copies of one plant, what the single and the vectorised environment share: deployments, episodes, spaces, info."""

from typing import Any

import jax
import numpy as np
from gymnasium.spaces import Box

from perfcontrol._checks import as_array, check_shape, fail
from perfcontrol.environments.regret import Oracle
from perfcontrol.environments.world import Episode, advance, begin, example, play, project
from perfcontrol.problem import PerformativeProblem, check_end

MODES = ("inputs", "policies")
OPTIONS = ("deploy",)


class Copies:
    """`count` plants that react each to a policy of its own."""

    episode: Episode

    def __init__(self, problem: PerformativeProblem | None, actions: str, regret: bool, count: int):
        self.problem = example() if problem is None else check_end(problem)
        if actions not in MODES:
            raise fail(
                "actions",
                repr(actions),
                f"be one of {MODES}",
                "Pass one of them: inputs u_t, or a policy for each episode.",
            )
        self.actions, self.count = actions, count
        self.oracle = Oracle(self.problem) if regret else None
        self.announced = np.repeat(np.asarray(self.problem.initial_policy())[None], count, axis=0)
        self.deployed = self.announced
        self._known: tuple[Any, dict[str, np.ndarray]] | None = None

    def spaces(self) -> tuple[Box, Box]:
        """Of observations and actions of one copy."""
        problem, dtype = self.problem, np.dtype(self.problem.dtype).type
        n, m, H = problem.state_size, problem.input_size, problem.memory
        shapes = [(n * (H + 1),), (m,)] if self.actions == "inputs" else [problem.policy_shape] * 2
        observations, actions = (Box(-np.inf, np.inf, shape, dtype) for shape in shapes)
        return observations, actions

    def reset(self, rng: np.random.Generator, options: dict[str, Any] | None) -> np.ndarray:
        """Begin an episode, after deploying what the options say; the observations."""
        options = options or {}
        for name in options:
            if name not in OPTIONS:
                raise fail("options", repr(name), f"hold {OPTIONS} alone", 'Pass options={"deploy": M}.')
        if "deploy" in options:
            self.announced = self._feasible(options["deploy"])
        self.deployed = self.announced
        if self.actions == "inputs":
            self.episode = begin(self.problem, self.deployed, self._keys(rng))
        return self.observe()

    def observe(self) -> np.ndarray:
        """The observations, (count, ...)."""
        if self.actions == "policies":
            return np.array(self.deployed)
        return np.concatenate([self.episode.x, self.episode.memory.reshape(self.count, -1)], axis=1)

    def act(self, actions: Any, rng: np.random.Generator) -> tuple[np.ndarray, bool, dict[str, np.ndarray]]:
        """The costs (count,) of these actions, whether the episode has ended with them, and what else is known."""
        problem = self.problem
        shape = (self.count, *self.spaces()[1].shape)
        actions = as_array("action", actions).reshape(shape).astype(problem.dtype)
        if self.actions == "policies":
            self.deployed = project(problem, actions)
            return play(problem, self.deployed, self._keys(rng)), False, {}
        self.episode, costs, matrices = advance(problem, self.episode, actions)
        ended = int(self.episode.t[0]) > problem.horizon
        width = self.episode.matrices.shape[3]
        return costs, ended, {} if ended else {"A": np.array(matrices[..., :width])}

    def info(self) -> dict[str, np.ndarray]:
        """Exact cost and regrets of the deployed policies, (count,) each."""
        if self.oracle is None:
            return {}
        if self._known is None or not np.array_equal(self._known[0], self.deployed):
            self._known = self.deployed, self.oracle.info(self.deployed)
        return {name: value.copy() for name, value in self._known[1].items()}

    def _keys(self, rng: np.random.Generator) -> Any:
        return jax.random.split(jax.random.key(int(rng.integers(2**32))), self.count)

    def _feasible(self, deploy: Any) -> np.ndarray:
        """The policies to deploy: one for all copies, or one each."""
        problem = self.problem
        policies = as_array("deploy", deploy)
        if policies.ndim == len(problem.policy_shape):
            policies = np.broadcast_to(policies, (self.count, *policies.shape))
        check_shape("deploy", policies, (self.count, *problem.policy_shape), ("copies", "memory", "input", "state"))
        policies = np.asarray(policies, problem.dtype)
        off = np.abs(np.asarray(project(problem, policies)) - policies).max()
        if off > 1e-3 * np.finfo(policies.dtype).eps ** 0.25 * max(np.abs(policies).max(), 1):
            required = "lie in the feasible set"
            raise fail("deploy", f"a policy {off:.3g} away", required, "Pass problem.feasible_set.project(M).")
        return policies
