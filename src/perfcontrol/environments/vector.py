"""Many copies of a plant as one Gymnasium vector environment."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from perfcontrol._checks import check_integer
from perfcontrol.environments.copies import Copies
from perfcontrol.problem import PerformativeProblem


class VectorPerformativeLDS(VectorEnv):
    """`PerformativeLDS` in many copies, worked on together; `gymnasium.make_vec` knows it by the same name.

    All copies end an episode in the same step. Autoreset is `AutoresetMode.NEXT_STEP`: the step after that one ignores
    its actions, begins new episodes and gives no reward. What `reset(options={"deploy": M})` deploys is one policy for
    all copies, or (num_envs, *policy_shape), one each. Entries of `info` have a leading axis over the copies.

    Args:
        num_envs: how many copies.
        problem: as `PerformativeLDS` takes it.
        actions: likewise.
        regret: likewise.

    Raises:
        InputError: no copy; else as `PerformativeLDS`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        problem: PerformativeProblem | None = None,
        actions: str = "inputs",
        regret: bool = True,
    ):
        self.num_envs = check_integer("num_envs", num_envs, 1)
        self._copies = Copies(problem, actions, regret, self.num_envs)
        self.single_observation_space, self.single_action_space = self._copies.spaces()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._ended = False

    @property
    def problem(self) -> PerformativeProblem:
        """The problem."""
        return self._copies.problem

    @property
    def deployed(self) -> np.ndarray:
        """The policies that the copies react to, (num_envs, *policy_shape)."""
        return self._copies.deployed.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every copy; see the class for `options`."""
        super().reset(seed=seed)
        self._ended = False
        return self._copies.reset(self.np_random, options), self._copies.info()

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One stage of every copy."""
        none = np.zeros(self.num_envs, bool)
        if self._ended:
            observations, info = self.reset()
            return observations, np.zeros(self.num_envs), none, none.copy(), info
        costs, self._ended, more = self._copies.act(actions, self.np_random)
        ended = np.full(self.num_envs, self._ended)
        return self._copies.observe(), -np.asarray(costs, float), ended, none, self._copies.info() | more
